"""What all messages have in common."""

from pydantic import BaseModel, ConfigDict


class Message(BaseModel):
    """A frozen message; unknown fields are refused so that a typing error doesn't pass as a setting."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)
