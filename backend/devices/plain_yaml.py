"""YAML files of rigs: read without surprises, refused in one sentence."""

from pathlib import Path
from typing import Any

import yaml

from backend.devices.errors import RigConfigError

MOST_BYTES = 4 << 20
MOST_ENTRIES = 500_000
"""Aliases counted as often as they are used: a few lines of them can stand for more than there is memory."""
_LONGEST = 160
"""Of the words of a library, in a sentence."""


class _Loader(yaml.SafeLoader):
    """Refuses a key that stands twice: the first entry would be lost without a word."""

    def get_single_node(self) -> Any:
        """Read the document's nodes, and count them."""
        node = super().get_single_node()
        if node is not None and _entries(node, {}) > MOST_ENTRIES:
            raise yaml.YAMLError(f"its aliases stand for more than {MOST_ENTRIES} entries")
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Read a mapping."""
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if len(set(keys)) < len(keys):
            twice = next(key for index, key in enumerate(keys) if key in keys[:index])
            raise yaml.YAMLError(
                f"{twice!r} stands twice in the entry that begins in line {node.start_mark.line + 1}"
            )
        return dict(super().construct_mapping(node, deep))


def _entries(node: Any, known: dict[int, int | None]) -> int:
    """Count the entries of a node with all that its aliases stand for; each node is looked at once."""
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) in known:
        count = known[id(node)]
        if count is None:
            raise yaml.YAMLError(f"the alias in line {node.start_mark.line + 1} stands for itself")
        return count
    known[id(node)] = None
    parts = node.value
    inner = [part for pair in parts for part in pair] if isinstance(node, yaml.MappingNode) else parts  # fmt: skip
    total = 1 + sum(_entries(part, known) for part in inner)
    known[id(node)] = total
    return total


def read_yaml(what: str, path: Path) -> Any:
    """Read a YAML file; `what` is what sentences call it.

    Raises
    ------
    RigConfigError
        If it can't be read, is too large, isn't YAML, or a key stands twice.
    """
    text = _text(what, path)
    try:
        return yaml.load(text, _Loader)  # noqa: S506  a safe loader
    except yaml.YAMLError as error:
        raise RigConfigError(
            f"{what} {path} isn't YAML ({_words(error)}); mend that line"
        ) from error
    except RecursionError:
        raise RigConfigError(f"{what} {path} is nested too deeply; mend its brackets") from None
    except (ValueError, KeyError, AttributeError, TypeError, OverflowError) as error:
        # What the library raises of a date without such a day, an integer of 5000 digits, `!!bool maybe`.
        words = " ".join(str(error).split())[:_LONGEST]
        raise RigConfigError(
            f"{what} {path} holds a value that isn't what it looks like ({words}); put it in quotes or mend it"
        ) from error


def _text(what: str, path: Path) -> str:
    try:
        if path.exists() and not path.is_file():
            raise RigConfigError(f"{what} {path} is no file; name one")
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise RigConfigError(
                f"{what} {path} has {size / 1e6:.1f} MB, at most {MOST_BYTES / 1e6:.1f} are read; check that it is the right"
                " file"
            )
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RigConfigError(
            f"{what} {path} is no UTF-8 text (byte {error.start} is {error.object[error.start]:#04x}); save it as UTF-8"
        ) from error
    except OSError as error:
        raise RigConfigError(
            f"{what} {path} can't be read ({error.strerror}); check name and rights"
        ) from error
    except ValueError as error:  # a zero byte in the name
        raise RigConfigError(
            f"{what} {str(path)!r} can't be read ({error}); check its name"
        ) from error


def _words(error: yaml.YAMLError) -> str:
    mark = getattr(error, "problem_mark", None)
    if mark is None:
        return " ".join(str(error).split())[:_LONGEST]
    problem = " ".join((getattr(error, "problem", "") or "wrong").split())
    return f"line {mark.line + 1}: {problem[:_LONGEST]}"
