"""Tables that are computed once and kept.

Where one is first asked for decides nothing: not inside ``torch.inference_mode``, whose tensors no
gradient may pass through later, nor while torch traces a program, when tensors hold no numbers.
"""

import functools
from collections.abc import Callable
from typing import Any, Generic, ParamSpec, TypeVar

import torch

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def kept(make: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """``make``, whose last eight results are kept; its arguments must be hashable."""
    remembered = functools.lru_cache(maxsize=8)(torch.inference_mode(False)(make))

    @functools.wraps(make)
    def made_once(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        if torch.compiler.is_compiling():
            return make(*args, **kwargs)
        return remembered(*args, **kwargs)

    return made_once


class kept_property(Generic[_Result]):
    """A property that is computed once and kept by its object, as :func:`kept` keeps results.

    While ``torch.export`` traces, it is computed anew. ``torch.compile`` keeps it: what it assigns
    to an object are the numbers of its first run.
    """

    def __init__(self, make: Callable[[Any], _Result]):
        self._make, self.__doc__ = make, make.__doc__

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: Any, owner: type | None = None) -> _Result:
        """Make it; where it is kept, the object's own attribute hides this one."""
        if traced_without_numbers():
            return self._make(instance)
        with torch.inference_mode(False):
            made = self._make(instance)
        setattr(instance, self._name, made)
        return made


def traced_without_numbers() -> bool:
    """Whether tensors made now hold no numbers and stay what they are when tracing ends."""
    return torch.compiler.is_compiling() and not torch.compiler.is_dynamo_compiling()
