"""Finds components by name, and builds components from a configuration.

A package declares its components in its ``__init__.py``: ``__interfaces__`` maps a kind of component to the class
from which the components inherit. ``__components__`` maps kinds to names, and names to classes or
``/a/file.py:Class``:

>>> __interfaces__ = {"resampler": "Resampler"}
>>> __components__ = {"resampler": {"systematic": "Systematic", "residual": "Residual"}}

A `Registry` joins the declarations of several packages. `mstfilter.runs.presets.REGISTRY` joins all packages:

>>> from mstfilter.runs.presets import REGISTRY
>>> REGISTRY.build("resampler", "systematic")
Systematic()
>>> REGISTRY.build("update", {"component": "crossover", "eta": 3, "free_space": "none"})

A configuration is a nested mapping. A component in a configuration is a name, or a mapping with the key ``component``
and fields. The annotation of a field determines the kind of its component. A field of type ``Resampler`` or
``Resampler | None`` holds a resampler, and a field of type ``tuple[Evidence, ...]`` holds a list of evidence terms.

A component is imported when it is first built. Looking up a name imports no component. Users name their own class as
``./file.py:Class`` (if `allow_files` is True), or add the class by an entry point ``kind.name`` of the group
``mstfilter.components``. A relative path is relative to the working folder. A file is executed once per process, and
again if its content has changed.
"""

from __future__ import annotations

import copyreg
import dataclasses
import difflib
import functools
import hashlib
import importlib
import importlib.util
import inspect
import sys
import tomllib
import typing
from collections.abc import Iterable, Iterator, Mapping
from datetime import date, time
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from mstfilter.base.code import code_of
from mstfilter.base.errors import (
    InputError,
    install_hint,
    missing_library,
    place_in_user_file,
    short_path,
    suggestion,
)

_ENTRY_POINTS = "mstfilter.components"


@functools.cache
def _installed_components() -> tuple[tuple[str, str], ...]:
    """Name and location of each entry point. The search reads the metadata of all installed packages in 15 ms."""
    return tuple((entry.name, entry.value) for entry in entry_points(group=_ENTRY_POINTS))


class Registry:
    """The components that packages declare by ``__components__``, ``__interfaces__`` or both."""

    def __init__(self, *packages: ModuleType) -> None:
        self._interfaces: dict[str, str] = {}  # location of the class -> kind
        self._components: dict[str, dict[str, str]] = {}  # kind -> name -> location
        for package in packages:
            for kind, cls in getattr(package, "__interfaces__", {}).items():
                self._interfaces[_location(package.__name__, cls)] = kind
                self._components.setdefault(kind, {})
        for package in packages:
            for kind, names in getattr(package, "__components__", {}).items():
                for name, cls in names.items():
                    self._components[kind][name] = _location(package.__name__, cls)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The names of all kinds of component."""
        return tuple(self._components)

    def known(self, kind: str) -> dict[str, str]:
        """Mapping from the names of components of a kind to locations ``package:Class``, including entry points."""
        names = dict(self._components[kind])
        for full_name, location in _installed_components():
            entry_kind, _, name = full_name.partition(".")
            if entry_kind == kind:
                names.setdefault(name, location)
        return names

    def interface(self, kind: str) -> type:
        """Import the class from which components of a kind inherit."""
        return _import(next(where for where, other in self._interfaces.items() if other == kind))

    def kind_of(self, annotation: Any) -> str | None:
        """The kind of component that a field with this annotation holds; None if the field holds a plain value."""
        for part in typing.get_args(annotation) or (annotation,):
            for base in getattr(part, "__mro__", ()):
                kind = self._interfaces.get(_location_of(base))
                if kind is not None:
                    return kind
        return None

    def check_names(self, cls: type, config: Mapping[str, Any], allow_files: bool = False) -> None:
        """Raise InputError if a field of `cls` names an unknown component, without importing components.

        Names in nested components are checked by `make`, which imports the components.
        """
        hints = typing.get_type_hints(cls)
        for field, value in config.items():
            kind = self.kind_of(hints.get(field))
            name = value.get("component") if isinstance(value, Mapping) else value
            if kind is not None and isinstance(name, str):
                self._locate(kind, name, field, allow_files)

    def find_class(self, kind: str, name: str, where: str | None = None, allow_files: bool = False) -> type:
        """Import the class of a component, by name."""
        location = self._locate(kind, name, where or kind, allow_files)
        path, _, attribute = location.partition(":")
        if path.endswith(".py"):
            found = _from_file(path, attribute)
            if kind in self.kinds and not issubclass(found, self.interface(kind)):
                interface = self.interface(kind)
                raise InputError(
                    f"{where or kind}: {attribute} of {path} is no {kind}: it does not inherit {interface.__name__}",
                    f"from {_front_door(interface)} import {interface.__name__}",
                )
            return found
        try:
            return _import(location)
        except ImportError as error:
            raise missing_library(error, f"{where or kind}: component {name!r}") from error

    def _locate(self, kind: str, name: str, where: str, allow_files: bool) -> str:
        if not isinstance(name, str):
            raise InputError(f"{where} is {name!r}, expected the name of a component")
        if ".py:" in name:
            if not allow_files:
                raise InputError(
                    f"{where}: {name!r} names a file, which is not loaded here",
                    "the commands that load files are run, study, check, convert, view and quality",
                )
            path = name.partition(":")[0]
            if not Path(path).is_file():
                raise InputError(f"{where}: file does not exist: {path}")
            return name
        names = self.known(kind)
        if name not in names:
            raise InputError(
                f"{where}: there is no {kind} {name!r}",
                *suggestion(name, names),
                f"there are: {', '.join(sorted(names))}; or ./file.py:Class",
            )
        return names[name]

    def build(
        self, kind: str, spec: Any, where: str | None = None, allow_files: bool = False, default: Any = None
    ) -> Any:
        """A component from its name, or from a mapping with the key ``component`` and fields.

        A mapping without ``component`` changes fields of `default`. Error messages contain `where`, the path of the
        component in the configuration. With `allow_files`, ``./file.py:Class`` is loaded.
        """
        where = where or kind
        if isinstance(spec, str):
            spec = {"component": spec}
        if not isinstance(spec, Mapping):
            raise InputError(f"{where} is {spec!r}, expected the name of a {kind} or a table")
        fields = dict(spec)
        name = fields.pop("component", None)
        if name is not None:
            return self.make(self.find_class(kind, name, where, allow_files), fields, where, allow_files)
        if default is None:
            names = ", ".join(sorted(self.known(kind)))
            raise InputError(f"{where} names no component", f"add component = one of {names}")
        return self.make(type(default), fields, where, allow_files, default)

    def make(
        self, cls: type, fields: Mapping[str, Any], where: str = "", allow_files: bool = False, base: Any = None
    ) -> Any:
        """Build a dataclass from plain values and nested components.

        Fields that are not given have their values in `base`, or their defaults if `base` is None. Raises InputError
        if a field or a component is unknown, or a value does not fit its field.
        """
        prefix = f"{where}: " if where else ""
        if inspect.isabstract(cls):
            raise _abstract_error(prefix, cls)
        if not dataclasses.is_dataclass(cls):
            raise InputError(
                f"{prefix}{cls.__name__} is no dataclass", "write @dataclass(frozen=True) above the class"
            )
        known = {field.name: field for field in dataclasses.fields(cls) if field.init}
        hints = typing.get_type_hints(cls)
        values = {}
        for name, value in fields.items():
            path = f"{where}.{name}" if where else name
            if name not in known:
                raise InputError(
                    f"{path}: {cls.__name__} has no field {name!r}",
                    *suggestion(name, known),
                    f"fields: {', '.join(known) or 'none'}",
                )
            current = default_of(known[name]) if base is None else getattr(base, name)
            values[name] = self._value(hints[name], value, current, path, allow_files)
        needed = [name for name, field in known.items() if default_of(field) is dataclasses.MISSING]
        missing = [name for name in needed if name not in values and base is None]
        if missing:
            path = f"{where}.{missing[0]}" if where else missing[0]
            raise InputError(
                f"{prefix}{cls.__name__} needs {', '.join(missing)}, without a default",
                f"give it a value, {path}=VALUE, or a default in the class",
            )
        try:
            return cls(**values) if base is None else dataclasses.replace(base, **values)
        except InputError as error:
            raise error.with_message(f"{prefix}{error.message}") from error
        except TypeError as error:
            raise InputError(f"{prefix}{cls.__name__} cannot be made: {error}") from error

    def _value(self, hint: Any, value: Any, current: Any, path: str, allow_files: bool) -> Any:
        """The value of a field with annotation `hint`. `current` is the field's default or its value in `base`."""
        kind = self.kind_of(hint)
        default = current if dataclasses.is_dataclass(current) else None
        if kind is not None and typing.get_origin(hint) is tuple and isinstance(value, str):
            value = [value]
        if kind is not None and isinstance(value, list):
            return tuple(self.build(kind, item, f"{path}[{k}]", allow_files) for k, item in enumerate(value))
        if kind is not None and value is None and type(None) in typing.get_args(hint):
            return None
        if kind is not None:
            return self.build(kind, value, path, allow_files, default)
        if default is not None and isinstance(value, Mapping):
            # A nested dataclass that is not a component: only its fields can be set.
            inner = {k: v for k, v in value.items() if k != "component"}
            return self.make(type(default), inner, path, allow_files, default)
        return _plain(hint, value, path)

    def describe(self, component: Any) -> dict[str, Any]:
        """The configuration that builds an equal component."""
        out: dict[str, Any] = {"component": self.name_of(type(component))}
        for field in dataclasses.fields(component):
            value = getattr(component, field.name)
            if dataclasses.is_dataclass(value) and not isinstance(value, type):
                value = self.describe(value)
            elif isinstance(value, tuple):
                value = [self.describe(v) if dataclasses.is_dataclass(v) else v for v in value]
            out[field.name] = value
        return out

    def name_of(self, cls: type) -> str:
        """The registered name of a class, its file, or its import path."""
        location = _location_of(cls)
        for names in self._components.values():
            for name, where in names.items():
                if where == location:
                    return name
        if "__mst_file__" in vars(cls):
            path, _, name = location.rpartition(":")
            return f"{short_path(path)}:{name}"
        return f"{cls.__module__}:{cls.__qualname__}"


def settings(overrides: Iterable[str], config: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Apply changes (``path=value``) to a configuration. The default configuration is empty."""
    return merged(config or {}, *map(_nested, overrides))


def merged(config: Mapping[str, Any], *changes: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration with changes. Naming a component resets its fields. Naming a field keeps the other fields."""
    found = dict(config)
    for name, value in (item for change in changes for item in change.items()):
        before = found.get(name)
        if before is not None and isinstance(value, Mapping) and "component" not in value:
            if not isinstance(before, (str, Mapping)):
                raise InputError(f"{name} is {before!r}, which has no fields")
            value = merged({"component": before} if isinstance(before, str) else before, value)
        found[name] = value
    return found


def _nested(override: str) -> dict[str, Any]:
    """The change that ``path=value`` describes, as nested mappings."""
    path, equals, text = override.partition("=")
    parts = path.strip().split(".")
    if not equals or not all(parts) or not text.strip():
        raise InputError(
            f"override {override!r} is not of the form path=value",
            "for example resampler=systematic or transition.rule=paper",
        )
    return functools.reduce(lambda value, part: {part: value}, reversed(parts), _toml_value(text.strip()))


def _toml_value(text: str) -> Any:
    """The value of a text in TOML syntax, or the text itself if it is a date or time or not valid TOML."""
    try:
        value = tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        return text
    return text if isinstance(value, date | time) else value


def nested_components(component: Any) -> Iterator[Any]:
    """A component and all components in its fields."""
    if isinstance(component, tuple):
        for part in component:
            yield from nested_components(part)
    elif dataclasses.is_dataclass(component) and not isinstance(component, type):
        yield component
        for field in dataclasses.fields(component):
            yield from nested_components(getattr(component, field.name))


def default_of(field: dataclasses.Field[Any]) -> Any:
    """The default of a dataclass field, from its default factory if it has one; MISSING if there is no default."""
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def _abstract_error(prefix: str, cls: type) -> InputError:
    """The error for a class that lacks methods of its interface."""
    missing = sorted(getattr(cls, "__abstractmethods__", ()))
    origin = next(base.__name__ for base in reversed(cls.__mro__) if missing[0] in vars(base))
    hint = f"define {missing[0]} as {origin}.{missing[0]} describes it"
    for close in difflib.get_close_matches(missing[0], vars(cls), n=1):
        hint = f"rename {close} to {missing[0]}"
    return InputError(f"{prefix}{cls.__name__} has no method {', '.join(missing)}, which {origin} asks for", hint)


def _location(package: str, cls: str) -> str:
    return cls if ":" in cls else f"{package}:{cls}"


def _location_of(cls: type) -> str:
    """Location of a class: ``package:Class`` with a package such as ``mstfilter.smc``, or ``file.py:Class``."""
    if "__mst_file__" in vars(cls):
        return str(cls.__mst_file__)  # type: ignore[attr-defined]
    return f"{_front_door(cls)}:{cls.__qualname__}"


def _front_door(cls: type) -> str:
    """The package from which a class is imported: the outermost one that exports it."""
    parts = cls.__module__.split(".")
    packages = (".".join(parts[:k]) for k in range(2, len(parts) + 1))
    exports = (p for p in packages if cls.__name__ in getattr(sys.modules.get(p), "__all__", ()))
    return next(exports, cls.__module__)


def _import(location: str) -> type:
    module, _, attribute = location.partition(":")
    found: type = getattr(importlib.import_module(module), attribute)
    return found


_MODULES: dict[tuple[Path, str], ModuleType] = {}  # resolved path and hash of the content of a file -> its module


def _from_file(path: str, attribute: str) -> type:
    module = load_file(path)
    found = getattr(module, attribute, None)
    if not isinstance(found, type):
        classes = ", ".join(cls.__name__ for cls in _classes_of(module))
        raise InputError(f"{path} has no class {attribute!r}", f"it has: {classes or 'none'}")
    return found


def load_attribute(location: str) -> Any:
    """What a Python file of the user holds under a name: ``./file.py:name``."""
    path, _, name = location.partition(":")
    if not Path(path).is_file():
        raise InputError(f"file does not exist: {path}")
    module = load_file(path)
    if not hasattr(module, name):
        raise InputError(f"{path} has no {name!r}", *suggestion(name, vars(module)))
    return getattr(module, name)


def load_file(path: str | Path) -> ModuleType:
    """The module made by executing a Python file of the user.

    A file is executed once per process for any spelling of its path, and again if its content has changed. Instances
    of its classes can be pickled, because unpickling loads the file.

    Raises InputError if the file cannot be read or executed.
    """
    resolved = Path(path).resolve()
    try:
        source = resolved.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    key = resolved, hashlib.sha256(source).hexdigest()
    if key not in _MODULES:
        _MODULES[key] = _executed(path, source, *key)
    return _MODULES[key]


def _executed(path: str | Path, source: bytes, resolved: Path, digest: str) -> ModuleType:
    """A new module from the source of a file. The module's name is unique for its path and content."""
    unique = hashlib.sha256(f"{resolved}\0{digest}".encode()).hexdigest()[:12]
    name = f"mstfilter_user_{resolved.stem}_{unique}"
    spec = importlib.util.spec_from_file_location(name, resolved)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses and pickle look their module up
    try:
        # The loader of `spec` takes stale bytecode for a file that is edited twice in a second.
        exec(compile(source, str(resolved), "exec"), vars(module))
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        place = place_in_user_file(error)
        hints = [place] if place else []
        if isinstance(error, ModuleNotFoundError):
            missing = str(error.name).partition(".")[0]
            hints.append(f"if {missing} is a library: {install_hint(missing)}")
            hints.append("a file beside it is found if its folder is in the environment variable PYTHONPATH")
        raise InputError(f"{path} cannot be loaded: {type(error).__name__}: {error}", *hints) from error
    for cls in _classes_of(module):
        cls.__mst_file__ = f"{resolved}:{cls.__qualname__}"  # type: ignore[attr-defined]
        cls.__mst_source__ = digest  # type: ignore[attr-defined]
        cls.__mst_code__ = hashlib.sha256(code_of(source)).hexdigest()  # type: ignore[attr-defined]
        if (cls.__reduce_ex__, cls.__reduce__) == (object.__reduce_ex__, object.__reduce__):
            cls.__reduce_ex__ = _reduce  # type: ignore[method-assign, assignment]
    return module


def _classes_of(module: ModuleType) -> list[type]:
    """The classes that a module itself defines, without imported classes."""
    return [v for v in vars(module).values() if isinstance(v, type) and v.__module__ == module.__name__]


def _reduce(instance: object, protocol: Any) -> Any:
    """Pickle an instance with the path of the class's file, as other processes cannot import the module by name."""
    reduced: Any = object.__reduce_ex__(instance, max(int(protocol), 2))
    how, arguments, *state = reduced
    cls = type(instance)
    if how is not copyreg.__newobj__ or "__mst_file__" not in vars(cls):  # type: ignore[attr-defined]
        return (how, arguments, *state)
    path, _, name = cls.__mst_file__.rpartition(":")  # type: ignore[attr-defined]
    return (_new_instance, (path, name, cls.__mst_source__, *arguments[1:]), *state)  # type: ignore[attr-defined]


def _new_instance(path: str, name: str, digest: str, *arguments: Any) -> Any:
    """A new instance, for unpickling. The user's file that defines the class must have the hash `digest`."""
    module = _MODULES.get((Path(path), digest)) or load_file(path)
    cls = getattr(module, name)
    if cls.__mst_source__ != digest:
        raise InputError(f"{path} has changed since an instance of {name} was pickled", "make the instance again")
    return cls.__new__(cls, *arguments)


def _paired(value: Any, found: Any) -> Iterator[tuple[Any, Any]]:
    """Each plain value with the value that it was converted to."""
    if isinstance(value, (list, tuple)) and isinstance(found, (list, tuple)):
        for inner in zip(value, found, strict=False):
            yield from _paired(*inner)
    else:
        yield value, found


def _plain(hint: Any, value: Any, where: str) -> Any:
    """A plain value, checked against a field's annotation. A ``tuple[X, ...]`` also accepts a single X."""
    from pydantic import TypeAdapter, ValidationError

    if typing.get_args(hint)[1:] == (...,) and isinstance(value, (bool, int, float, str)):
        value = [value]
    try:
        found = TypeAdapter(hint).validate_python(value)
        if any(isinstance(v, bool) and type(f) in (int, float) for v, f in _paired(value, found)):
            raise InputError(f"{where} is {value!r}, expected a number")  # pydantic reads true as 1
        return found
    except ValidationError as error:
        raise InputError(f"{where} is {value!r}: {error.errors()[0]['msg'].lower()}") from error
