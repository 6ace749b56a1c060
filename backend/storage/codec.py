"""Results as JSON documents, and back: guided by the types' annotations.

Arrays go to the artifact store and leave `{"$array": hash, "shape": [...], "dtype": "<f4"}` behind, frames
`{"$frame": {..., "image": {"$array": ...}}}`, numbers that JSON doesn't have `{"$float": "nan"}`. So a
document is small, has one hash, and equal arrays are stored once wherever they stand.
"""

import dataclasses
import enum
import math
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import AbstractArray
from pydantic import BaseModel, TypeAdapter, ValidationError

from backend.domain.errors import CorruptDataError
from backend.domain.frames import Frame, Pixels
from backend.domain.hashing import document_hash
from backend.storage.artifacts import ArtifactMeta, ArtifactStore, StoredPixels

Document = dict[str, Any]

_SCALARS = (bool, int, float, str)
_SPECIAL = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def encode(result: Any, store: ArtifactStore) -> Document:
    """Write a result as a document; its arrays go to the store.

    Parameters
    ----------
    result
        An instance of a frozen dataclass whose fields are annotated with: numbers, texts, enumerations,
        None, numpy arrays (bare or with shapes), frames, pixels, pydantic models, named tuples, other
        dataclasses, `tuple[...]`, `list[...]`, `Mapping[str, ...]`, `X | None`, unions of models, of
        arrays, or of numbers and texts, `Annotated[...]`; `Any` stands for JSON values.
    store
        Takes the arrays. A mapped array or a frame that is in it already isn't read again.

    Raises
    ------
    TypeError
        If a field's type or value isn't one of these; the text names the field.
    StorageFullError
        If there is no room for an array.
    """
    document = _Encoder(store).encode(result, type(result), type(result).__name__)
    if not isinstance(document, dict):
        raise TypeError(f"{type(result).__name__} isn't a dataclass and can't be a result")
    return document


def decode(document: Mapping[str, Any], kind: type, store: ArtifactStore) -> Any:
    """Make a result of that type from a document: arrays come back mapped, frames are loaded when looked at.

    Fields that the type has got since take their default; fields that it has lost are passed over.

    Raises
    ------
    CorruptDataError
        If the document doesn't fit the type; the sentence names the field.
    NotFoundError
        If an array isn't in the store.
    """
    return _Decoder(store).decode(document, kind, kind.__name__)


def content_hash(document: Mapping[str, Any]) -> str:
    """Hash an encoded result: what the keys of the stages that read it are made of."""
    return document_hash(document)


def references(document: Any) -> Iterator[str]:
    """Return the hashes of all artifacts that a document refers to."""
    if isinstance(document, Mapping):
        if "$array" in document:
            yield document["$array"]
        for value in document.values():
            yield from references(value)
    elif isinstance(document, list | tuple):
        for value in document:
            yield from references(value)


class _Shape(NamedTuple):
    """An annotation, taken apart."""

    kind: str
    origin: Any
    arguments: tuple[Any, ...] = ()


@lru_cache(maxsize=4096)
def _shape(annotation: Any) -> _Shape:
    """Say how values of an annotation are written; kind `unknown` if they can't be."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return _shape_of_union(annotation, arguments)
    if origin is typing.Literal:
        return _Shape("scalar", None)
    if isinstance(origin, type):
        return _shape_of_generic(origin, arguments)
    if annotation is Any:
        return _Shape("json", None)
    if isinstance(annotation, type):
        return _shape_of_class(annotation)
    return _Shape("unknown", annotation)


def _shape_of_union(annotation: Any, members: tuple[Any, ...]) -> _Shape:
    """One type or None, a union of models (told apart by their fields), of arrays, or of numbers and texts."""
    others = tuple(member for member in members if member is not type(None))
    if len(others) < len(members):
        return _Shape("optional", None, (typing.Union[others],))  # noqa: UP007 (made at run time)
    kinds = {_shape(member).kind for member in members}
    if kinds == {"model"}:
        return _Shape("model", annotation)
    if kinds in ({"scalar"}, {"array"}):
        return _Shape(kinds.pop(), None)
    return _Shape("unknown", annotation)


def _shape_of_generic(origin: type, arguments: tuple[Any, ...]) -> _Shape:
    if issubclass(origin, np.ndarray):
        return _Shape("array", np.ndarray)
    if origin is tuple and len(arguments) == 2 and arguments[1] is Ellipsis:
        return _Shape("sequence", tuple, arguments[:1])
    if origin is tuple:
        return _Shape("tuple", tuple, arguments)
    if issubclass(origin, Mapping):
        return _Shape("mapping", dict, arguments)
    if issubclass(origin, Sequence):
        return _Shape("sequence", list if origin is list else tuple, arguments)
    return _Shape("unknown", origin)


def _shape_of_class(plain: type) -> _Shape:
    if issubclass(plain, AbstractArray | np.ndarray):
        return _Shape("array", np.ndarray)
    if plain is Frame:
        return _Shape("frame", plain)
    if plain is Pixels:
        return _Shape("pixels", plain)
    if issubclass(plain, enum.Enum):
        return _Shape("enum", plain)
    if issubclass(plain, BaseModel):
        return _Shape("model", plain)
    if plain is type(None):
        return _Shape("none", plain)
    if plain in _SCALARS:
        return _Shape("scalar", plain)
    if dataclasses.is_dataclass(plain) or (issubclass(plain, tuple) and hasattr(plain, "_fields")):
        return _Shape("record", plain)
    return _Shape("unknown", plain)


@lru_cache(maxsize=512)
def _fields(record: Any) -> dict[str, Any]:
    """Return the annotations of the fields that make an instance."""
    hints = typing.get_type_hints(record)  # without view hints: they don't change how it is stored
    if not dataclasses.is_dataclass(record):
        return {name: hints[name] for name in record._fields}
    return {f.name: hints[f.name] for f in dataclasses.fields(record) if f.init}


@lru_cache(maxsize=512)
def _optional_fields(record: Any) -> set[str]:
    """Return the names of the fields that have a default."""
    if not dataclasses.is_dataclass(record):
        return set(record._field_defaults)
    missing = dataclasses.MISSING
    return {
        f.name
        for f in dataclasses.fields(record)
        if f.default is not missing or f.default_factory is not missing
    }


@lru_cache(maxsize=512)
def _adapter(annotation: Any) -> Any:  # a TypeAdapter, which beartype has no words for
    return TypeAdapter(annotation)


class _Encoder:
    """Writes values; one method per kind of annotation."""

    def __init__(self, store: ArtifactStore) -> None:
        self._store = store

    def encode(self, value: Any, annotation: Any, path: str) -> Any:
        shape = _shape(annotation)
        write = getattr(self, f"_{shape.kind}", None)
        if write is None:
            raise TypeError(
                f"{path} is annotated {annotation!r}, which can't be stored; see backend/storage/codec.py "
                f"for what can"
            )
        return write(value, shape, path)

    def _none(self, value: Any, shape: _Shape, path: str) -> None:
        _expect(value is None, value, "None", path)

    def _optional(self, value: Any, shape: _Shape, path: str) -> Any:
        return None if value is None else self.encode(value, shape.arguments[0], path)

    def _scalar(self, value: Any, shape: _Shape, path: str) -> Any:
        if isinstance(value, enum.Enum):
            raise TypeError(f"{path} is {value!r}; annotate it with its enumeration")
        if isinstance(value, np.generic):
            value = value.item()
        wanted = shape.origin or (*_SCALARS, type(None))
        if wanted is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        exact = type(value) is bool if wanted is bool else isinstance(value, wanted)
        refused = wanted is int and isinstance(value, bool)
        _expect(exact and not refused, value, getattr(wanted, "__name__", "a number or text"), path)
        return _json_float(value) if isinstance(value, float) else value

    def _json(self, value: Any, shape: _Shape, path: str) -> Any:
        if isinstance(value, Mapping):
            return {_key(k, path): self._json(v, shape, f"{path}[{k!r}]") for k, v in value.items()}
        if isinstance(value, list | tuple):
            return [self._json(v, shape, f"{path}[{n}]") for n, v in enumerate(value)]
        return self._scalar(value, _Shape("scalar", None), path)

    def _enum(self, value: Any, shape: _Shape, path: str) -> Any:
        _expect(isinstance(value, shape.origin), value, shape.origin.__name__, path)
        return value.value

    def _model(self, value: Any, shape: _Shape, path: str) -> Any:
        _expect(isinstance(value, BaseModel), value, "a pydantic model", path)
        try:
            checked = _adapter(shape.origin).validate_python(value)
        except ValidationError as error:
            raise TypeError(f"{path} is {value!r}, which its annotation doesn't allow") from error
        return _adapter(shape.origin).dump_python(checked, mode="json")

    def _array(self, value: Any, shape: _Shape, path: str) -> Document:
        _expect(isinstance(value, np.ndarray | np.generic), value, "a numpy array", path)
        try:
            return _array_document(self._store.put(np.asarray(value)))
        except TypeError as error:
            raise TypeError(f"{path}: {error}") from error

    def _pixels(self, value: Any, shape: _Shape, path: str) -> Document:
        _expect(isinstance(value, Pixels), value, "pixels", path)
        if isinstance(value, StoredPixels) and value.hash in self._store:
            return _array_document(value.meta)
        return self._array(value.load(), shape, path)

    def _frame(self, value: Any, shape: _Shape, path: str) -> Document:
        _expect(isinstance(value, Frame), value, "a frame", path)
        fields = {
            name: self.encode(getattr(value, name), annotation, f"{path}.{name}")
            for name, annotation in _fields(Frame).items()
            if name != "pixels"
        }
        return {"$frame": {**fields, "image": self._pixels(value.pixels, shape, f"{path}.pixels")}}

    def _record(self, value: Any, shape: _Shape, path: str) -> Document:
        _expect(type(value) is shape.origin, value, shape.origin.__name__, path)
        return {
            name: self.encode(getattr(value, name), annotation, f"{path}.{name}")
            for name, annotation in _fields(shape.origin).items()
        }

    def _mapping(self, value: Any, shape: _Shape, path: str) -> Document:
        _expect(isinstance(value, Mapping), value, "a mapping", path)
        keys, values = shape.arguments
        _expect(keys is str, keys, "a mapping whose keys are texts", path)
        return {_key(k, path): self.encode(v, values, f"{path}[{k!r}]") for k, v in value.items()}

    def _sequence(self, value: Any, shape: _Shape, path: str) -> list[Any]:
        _expect(isinstance(value, list | tuple), value, "a tuple", path)
        kind = shape.arguments[0]
        return [self.encode(v, kind, f"{path}[{n}]") for n, v in enumerate(value)]

    def _tuple(self, value: Any, shape: _Shape, path: str) -> list[Any]:
        fits = isinstance(value, tuple) and len(value) == len(shape.arguments)
        _expect(fits, value, f"a tuple of {len(shape.arguments)}", path)
        pairs = zip(value, shape.arguments, strict=True)
        return [self.encode(v, kind, f"{path}[{n}]") for n, (v, kind) in enumerate(pairs)]


class _Decoder:
    """Reads values; one method per kind of annotation."""

    def __init__(self, store: ArtifactStore) -> None:
        self._store = store

    def decode(self, value: Any, annotation: Any, path: str) -> Any:
        shape = _shape(annotation)
        read = getattr(self, f"_{shape.kind}", None)
        if read is None:
            raise TypeError(
                f"{path} is annotated {annotation!r}, which can't be read from a document"
            )
        try:
            return read(value, shape, path)
        except (KeyError, ValueError, AttributeError, IndexError) as error:
            raise _unfit(path, value) from error

    def _none(self, value: Any, shape: _Shape, path: str) -> None:
        if value is not None:
            raise _unfit(path, value)

    def _optional(self, value: Any, shape: _Shape, path: str) -> Any:
        return None if value is None else self.decode(value, shape.arguments[0], path)

    def _scalar(self, value: Any, shape: _Shape, path: str) -> Any:
        value = _from_json_float(value)
        wanted = shape.origin
        if wanted is float and type(value) is int:
            return float(value)
        if isinstance(value, Mapping | list) or (wanted and type(value) is not wanted):
            raise _unfit(path, value)
        return value

    def _json(self, value: Any, shape: _Shape, path: str) -> Any:
        if isinstance(value, Mapping) and "$float" not in value:
            return {k: self._json(v, shape, path) for k, v in value.items()}
        if isinstance(value, list):
            return [self._json(v, shape, path) for v in value]
        return _from_json_float(value)

    def _enum(self, value: Any, shape: _Shape, path: str) -> Any:
        return shape.origin(value)

    def _model(self, value: Any, shape: _Shape, path: str) -> Any:
        return _adapter(shape.origin).validate_python(value)

    def _array(self, value: Any, shape: _Shape, path: str) -> Any:
        return self._store.get(_hash_in(value, path))

    def _pixels(self, value: Any, shape: _Shape, path: str) -> StoredPixels:
        return _stored(self._store, value, path)

    def _frame(self, value: Any, shape: _Shape, path: str) -> Any:
        fields = dict(value["$frame"])
        fields["pixels"] = fields.pop("image")
        return self._record(fields, shape, path)

    def _record(self, value: Any, shape: _Shape, path: str) -> Any:
        if not isinstance(value, Mapping):
            raise _unfit(path, value)
        annotations = _fields(shape.origin)
        known = {
            name: self.decode(value[name], annotation, f"{path}.{name}")
            for name, annotation in annotations.items()
            if name in value
        }
        if missing := sorted(set(annotations) - set(known) - _optional_fields(shape.origin)):
            raise CorruptDataError(
                f"a stored result is damaged or of another version: {path} lacks {', '.join(missing)}; "
                f"run its stage again"
            )
        return shape.origin(**known)

    def _mapping(self, value: Any, shape: _Shape, path: str) -> dict[str, Any]:
        kind = shape.arguments[1]
        return {k: self.decode(v, kind, f"{path}[{k!r}]") for k, v in value.items()}

    def _sequence(self, value: Any, shape: _Shape, path: str) -> Any:
        if not isinstance(value, list):
            raise _unfit(path, value)
        kind = shape.arguments[0]
        return shape.origin(self.decode(v, kind, f"{path}[{n}]") for n, v in enumerate(value))

    def _tuple(self, value: Any, shape: _Shape, path: str) -> tuple[Any, ...]:
        if not isinstance(value, list) or len(value) != len(shape.arguments):
            raise _unfit(path, value)
        pairs = zip(value, shape.arguments, strict=True)
        return tuple(self.decode(v, kind, f"{path}[{n}]") for n, (v, kind) in enumerate(pairs))


def _expect(fits: bool, value: Any, wanted: str, path: str) -> None:
    if not fits:
        raise TypeError(f"{path} has to be {wanted}, not {value!r:.200}")


def _unfit(path: str, value: Any) -> CorruptDataError:
    return CorruptDataError(
        f"a stored result is damaged or of another version: {path} can't be {value!r:.80}; run its stage again"
    )


def _key(key: Any, path: str) -> str:
    _expect(isinstance(key, str), key, "a mapping whose keys are texts", path)
    _expect(
        not key.startswith("$"), key, "a mapping whose keys don't start with a dollar sign", path
    )
    return str(key)


def _json_float(value: float) -> Any:
    if math.isfinite(value):
        return value
    return {"$float": "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"}


def _from_json_float(value: Any) -> Any:
    return _SPECIAL[value["$float"]] if isinstance(value, Mapping) and "$float" in value else value


def _array_document(meta: ArtifactMeta) -> Document:
    return {"$array": meta.hash, "shape": list(meta.shape), "dtype": meta.dtype}


def _hash_in(value: Any, path: str) -> str:
    if not isinstance(value, Mapping) or not isinstance(value.get("$array"), str):
        raise _unfit(path, value)
    return str(value["$array"])


def _stored(store: ArtifactStore, value: Any, path: str) -> StoredPixels:
    hash = _hash_in(value, path)
    try:
        dtype, shape = np.dtype(value["dtype"]), tuple(int(n) for n in value["shape"])
    except TypeError as error:
        raise _unfit(path, value) from error
    size_bytes = dtype.itemsize * math.prod(shape)
    return StoredPixels(store, hash, ArtifactMeta(hash, shape, dtype.str, size_bytes))
