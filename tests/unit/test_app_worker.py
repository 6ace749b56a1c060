"""The thread that does one thing after the other."""

import threading
from collections.abc import Callable, Iterator
from functools import partial

import pytest

from app.worker import Worker

PATIENCE_S = 20.0


@pytest.fixture
def worker() -> Iterator[tuple[Worker, list[Exception]]]:
    errors: list[Exception] = []
    made = Worker("test", errors.append)
    yield made, errors
    made.close()
    made.join(PATIENCE_S)


def held(worker: Worker) -> Callable[[], None]:
    """Hold the worker until the returned function is called."""
    go, reached = threading.Event(), threading.Event()

    def hold() -> None:
        reached.set()
        go.wait(PATIENCE_S)

    worker.submit(hold)
    assert reached.wait(PATIENCE_S)
    return go.set


def finished(worker: Worker) -> None:
    done = threading.Event()
    worker.submit(done.set)
    assert done.wait(PATIENCE_S)


def test_work_is_done_in_order(worker: tuple[Worker, list[Exception]]) -> None:
    done: list[int] = []
    for i in range(5):
        worker[0].submit(partial(done.append, i))
    finished(worker[0])

    assert done == [0, 1, 2, 3, 4]


def test_newer_work_with_the_same_key_replaces_what_waits(
    worker: tuple[Worker, list[Exception]],
) -> None:
    done: list[str] = []
    go = held(worker[0])
    for text, key in (("old", "a"), ("other", None), ("new", "a")):
        worker[0].submit(partial(done.append, text), key=key)
    go()
    finished(worker[0])

    assert done == ["other", "new"]


def test_an_error_is_reported_and_the_next_work_done(
    worker: tuple[Worker, list[Exception]],
) -> None:
    def fail() -> None:
        raise ValueError("broken")

    worker[0].submit(fail)
    finished(worker[0])

    assert [str(e) for e in worker[1]] == ["broken"]


def test_closing_drops_what_waits() -> None:
    done: list[int] = []
    worker = Worker("test", lambda _: None)
    go = held(worker)
    worker.submit(lambda: done.append(1))
    worker.close()
    go()
    worker.join(PATIENCE_S)

    assert done == []
