"""The file of an HTML form, as it arrives: nothing of it is kept in memory or in a temporary file."""

from collections.abc import AsyncIterator

from python_multipart import MultipartParser
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import parse_options_header

from backend.domain.errors import InvalidCaptureError

_LONGEST_FIELD_BYTES = 4096


class FormFile:
    """Reads `multipart/form-data` with one file; small fields beside it are kept as text.

    Parameters
    ----------
    body
        The request's body.
    content_type
        Its header, with the boundary.

    Raises
    ------
    InvalidCaptureError
        If the header names no boundary, or later, while reading, if the body is no such form.
    """

    def __init__(self, body: AsyncIterator[bytes], content_type: str) -> None:
        _, options = parse_options_header(content_type)
        self.fields: dict[str, str] = {}
        """Complete when all of the file has been read."""
        self._body = body
        self._header = self._value = self._disposition = b""
        self._name, self._is_file = "", False
        self._small = bytearray()
        self._pieces: list[bytes] = []
        try:
            self._parser = MultipartParser(
                options[b"boundary"],
                {
                    "on_part_begin": self._begin,
                    "on_header_field": self._header_name,
                    "on_header_value": self._header_value,
                    "on_header_end": self._header_end,
                    "on_headers_finished": self._headers_end,
                    "on_part_data": self._data,
                    "on_part_end": self._end,
                },
            )
        except (KeyError, FormParserError) as error:
            raise InvalidCaptureError(
                "The form has no boundary between its fields; send the zip file itself."
            ) from error

    async def pieces(self) -> AsyncIterator[bytes]:
        """Return the file piece by piece."""
        try:
            async for chunk in self._body:
                self._parser.write(chunk)
                for piece in self._pieces:
                    yield piece
                self._pieces.clear()
            self._parser.finalize()
        except FormParserError as error:
            raise InvalidCaptureError(
                f"The form can't be read ({error}); send the zip file itself."
            ) from error

    def _begin(self) -> None:
        self._disposition, self._small = b"", bytearray()

    def _header_name(self, data: bytes, start: int, end: int) -> None:
        self._header += data[start:end]

    def _header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def _header_end(self) -> None:
        if self._header.lower() == b"content-disposition":
            self._disposition = self._value
        self._header = self._value = b""

    def _headers_end(self) -> None:
        _, options = parse_options_header(self._disposition)
        self._name = options.get(b"name", b"").decode("utf-8", "replace")
        self._is_file = b"filename" in options

    def _data(self, data: bytes, start: int, end: int) -> None:
        if self._is_file:
            self._pieces.append(data[start:end])
        elif len(self._small) < _LONGEST_FIELD_BYTES:
            self._small += data[start:end]

    def _end(self) -> None:
        if not self._is_file:
            text = bytes(self._small[:_LONGEST_FIELD_BYTES]).decode("utf-8", "replace")
            self.fields[self._name] = text
