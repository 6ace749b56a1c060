"""Column types that mean the same on SQLite and PostgreSQL."""

import enum
import json
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import JSON, BigInteger, DateTime, Enum, Integer, Text
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.engine import Dialect
from sqlalchemy.types import TypeDecorator

SEARCHABLE = JSON().with_variant(JSONB(), "postgresql")
"""A JSON object of our own making that PostgreSQL may index; see `ExactJson` for what it doesn't keep."""

SEQUENCE = BigInteger().with_variant(Integer(), "sqlite")
"""Number that the database counts up (SQLite does so for INTEGER only)."""


class Words(TypeDecorator[str]):
    """Text. The character 0 and half a surrogate pair, which PostgreSQL refuses, become a question mark."""

    impl = Text
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | None:
        """Replace what can't be stored everywhere: nobody types it, but anybody can send it."""
        if value is None:
            return None
        return value.replace("\0", "?").encode("utf-8", "replace").decode()


class ExactJson(TypeDecorator[Any]):
    """JSON values as the text that was written: for all that enters a hash or becomes a result again.

    Neither database's own JSON column does: PostgreSQL's JSONB forgets the order of keys, -0.0 and
    whether 1e16 was a float, and refuses the character 0; SQLite turns a text such as `3.0` in a column named JSON into the number 3.
    """

    impl = Text
    cache_ok = True
    should_evaluate_none = True
    """None is JSON's null, an ordinary value of a setting (automatic)."""

    def process_bind_param(self, value: Any, dialect: Dialect) -> str | None:
        """Write the values as text; NaN is refused, JSON has none."""
        return json.dumps(value, allow_nan=False, separators=(",", ":"))

    def process_result_value(self, value: str | None, dialect: Dialect) -> Any:
        """Read them back."""
        return None if value is None else json.loads(value)


class ExactJsonOrNull(ExactJson):
    """The same for a column that may be empty: None is SQL's NULL."""

    cache_ok = True
    should_evaluate_none = False

    def process_bind_param(self, value: Any, dialect: Dialect) -> str | None:
        """Write the values as text, or nothing."""
        return None if value is None else super().process_bind_param(value, dialect)


class UtcDateTime(TypeDecorator[datetime]):
    """An aware moment in UTC. SQLite has no zones: there it is stored without, and gets UTC back."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Refuse a moment without a zone: nobody could tell later which one was meant."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError(f"{value!r} has no time zone; use datetime.now(UTC)")
        moment = value.astimezone(UTC)
        return moment.replace(tzinfo=None) if dialect.name == "sqlite" else moment

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return the moment in UTC."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


def one_of(kind: type[enum.StrEnum], name: str) -> Enum:
    """Store an enumeration as its words, checked by a constraint `ck_<table>_<name>`."""

    def values(members: Any) -> list[str]:
        return [member.value for member in members]

    return Enum(
        kind,
        name=name,
        native_enum=False,
        create_constraint=True,
        length=32,
        values_callable=values,
    )
