"""Tables that are computed once and kept.

Where one is first asked for decides nothing: not inside ``torch.inference_mode``, whose tensors no
gradient may pass through later, nor while torch traces a program, when tensors hold no numbers.
"""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

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
