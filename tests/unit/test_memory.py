"""What is remembered, and what is forgotten first."""

from backend.services.memory import Memory


def test_what_was_looked_at_longest_ago_is_forgotten_first() -> None:
    memory: Memory[bytes] = Memory(30, len)
    made: list[str] = []

    def picture(name: str) -> bytes:
        def make() -> bytes:
            made.append(name)
            return name.encode() * 10

        return memory.get(name, make)

    for name in "abcabdabca":
        assert picture(name) == name.encode() * 10
    assert made == ["a", "b", "c", "d", "c"]
    assert memory.get("large", lambda: b"x" * 31) == b"x" * 31


def test_things_count_one_by_default() -> None:
    memory: Memory[str] = Memory(2)
    made = []
    for name in "abcabc":
        memory.get(name, lambda name=name: made.append(name) or name)  # type: ignore[func-returns-value, misc]  # append returns None
    assert made == list("abcabc")
