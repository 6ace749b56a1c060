"""What was made lately, so that it needn't be made again."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Made = TypeVar("Made")


def _one(made: object) -> int:
    return 1


class Memory(Generic[Made]):
    """The things that were looked at last, up to a size.

    Parameters
    ----------
    capacity
        Largest sum of the things' sizes.
    size
        Measures a thing; by default every thing counts 1.
    """

    def __init__(self, capacity: int, size: Callable[[Made], int] = _one) -> None:
        self._capacity = capacity
        self._size = size
        self._used = 0
        self._lock = threading.Lock()
        self._things: OrderedDict[Hashable, Made] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Made]) -> Made:
        """Return the thing of a key, made now if it isn't remembered; from any thread."""
        with self._lock:
            if key in self._things:
                self._things.move_to_end(key)
                return self._things[key]
        made = make()
        with self._lock:
            if key not in self._things and self._size(made) <= self._capacity:
                self._things[key] = made
                self._used += self._size(made)
            while self._used > self._capacity:
                self._used -= self._size(self._things.popitem(last=False)[1])
        return made
