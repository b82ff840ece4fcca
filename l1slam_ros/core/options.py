# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Options: frozen dataclasses whose fields carry their meaning, unit and range.

They become ROS parameters and lines of a YAML file, so a field is a bool, int, float, str or
strings, or another `Options`. A default is written once, at its field.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, TypeVar

from l1slam_ros.core.errors import OptionError, require

Scalar = bool | int | float | str | tuple[str, ...]
AnyOptions = TypeVar('AnyOptions', bound='Options')


@dataclass(frozen=True)
class Meaning:
    """What a field means: one sentence, its unit, and what it may be."""

    doc: str
    unit: str = ''
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    fixed: bool = False
    """Read once at start; a running node refuses to change it."""

    def expected(self) -> str:
        """Return the allowed values in words."""
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        return f'{self.low:g} to {self.high:g}'

    def allows(self, value: Scalar) -> bool:
        """Tell whether a value of the right type is in range; NaN never is."""
        if self.choices:
            return value in self.choices
        if self.low is None or self.high is None:
            return True
        return isinstance(value, int | float) and self.low <= value <= self.high


def option(default: Scalar, doc: str, unit: str = '', low: float | None = None,
           high: float | None = None, choices: tuple[str, ...] = (), fixed: bool = False) -> Any:
    """Return a dataclass field with its meaning attached."""
    meaning = Meaning(doc, unit, low, high, choices, fixed)
    return field(default=default, metadata={'meaning': meaning})


@dataclass(frozen=True)
class Options:
    """
    Base of all options: refuses values outside their type and range.

    PASSED_OVER : names, or first parts of dotted ones, that `from_mapping` takes no notice of
    """

    PASSED_OVER: ClassVar[frozenset[str]] = frozenset()

    def __post_init__(self) -> None:
        """Check every field; ints are taken for floats, as people write them."""
        for f in fields(self):
            if 'meaning' not in f.metadata:
                nested = type(f.default)
                require(nested, f.name, getattr(self, f.name),
                        f'{nested.__name__}; {nested.__name__}.from_mapping makes it of a mapping')
                continue
            meaning = f.metadata['meaning']
            value = getattr(self, f.name)
            kind = type(f.default)
            if kind is float and type(value) is int:
                value = float(value)
                object.__setattr__(self, f.name, value)
            if kind is tuple and isinstance(value, list | tuple) and all(
                    type(one) is str for one in value):
                value = tuple(value)
                object.__setattr__(self, f.name, value)
            if type(value) is not kind:
                raise OptionError(f'{f.name} is {value!r}, expected a value of type '
                                  f'{"list of str" if kind is tuple else kind.__name__}')
            if not meaning.allows(value):
                raise OptionError(f'{f.name} is {value!r}, expected {meaning.expected()}')

    @classmethod
    def from_mapping(cls: 'type[AnyOptions]', values: Mapping[str, Any]) -> 'AnyOptions':
        """
        Return the options with the values that a mapping sets, the defaults for the rest.

        values : by name; those of nested options in a mapping of their own, or by dotted names

        Raises
        ------
        OptionError : no mapping, an unknown name, one set twice, or a value that is refused.

        """
        if not isinstance(values, Mapping):
            raise OptionError(f'options are {values!r}, expected a mapping of names to values')
        flat: dict[str, Scalar] = {}
        for name, value in dotted(values):
            if name.split('.')[0] in cls.PASSED_OVER:
                continue
            if name in flat:
                raise OptionError(f'{name} is set twice, to {flat[name]!r} and to {value!r}')
            flat[name] = value
        return with_values(cls(), flat)


def dotted(values: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """Yield dotted name and value of everything in nested mappings."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from dotted(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}', value


def flatten(options: Options, prefix: str = '') -> dict[str, tuple[Scalar, Meaning]]:
    """Return dotted name -> (value, meaning) of every field, nested ones included."""
    flat: dict[str, tuple[Scalar, Meaning]] = {}
    for f in fields(options):
        value = getattr(options, f.name)
        if isinstance(value, Options):
            flat.update(flatten(value, f'{prefix}{f.name}.'))
        else:
            flat[prefix + f.name] = (value, f.metadata['meaning'])
    return flat


def with_values(options: AnyOptions, values: Mapping[str, Scalar], prefix: str = '') -> AnyOptions:
    """
    Return the options with some fields, named by dotted names, replaced.

    Raises
    ------
    OptionError : naming the unknown name, or the value and what was expected.

    """
    unknown = set(values) - set(flatten(options))
    if unknown:
        raise OptionError(f'no option is called {prefix}{min(unknown)}')
    changes: dict[str, Any] = {}
    for f in fields(options):
        inner = {name[len(f.name) + 1 :]: value for name, value in values.items()
                 if name.startswith(f.name + '.')}
        if f.name in values:
            changes[f.name] = values[f.name]
        elif inner:
            changes[f.name] = with_values(getattr(options, f.name), inner, f'{prefix}{f.name}.')
    try:
        return replace(options, **changes)
    except OptionError as error:
        raise OptionError(f'{prefix}{error}') from error
