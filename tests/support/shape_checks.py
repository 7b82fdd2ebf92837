"""Check the arrays that functions take and return against their annotations while tests run.

jaxtyping's import hook wraps the functions and dataclasses of the modules below. The wrapper is
`checked`: it checks values with `typeguard.check_type` (typeguard is a dependency of tyro).
typeguard's own decorator cannot parse shape strings. JAXTYPING_DISABLE=1 switches all checks off.
"""

import contextlib
import functools
import inspect
from collections.abc import Callable, Iterator
from typing import Any, get_args

import jaxtyping
import numpy as np
from jaxtyping import AbstractArray, AnnotationError
from typeguard import TypeCheckError, check_type

MODULES = (
    "climatenerf.core",
    "climatenerf.evaluation.metrics",
    "climatenerf.ops.reference",
    "climatenerf.weather.flood",
    "climatenerf.weather.smog.medium",
    "climatenerf.weather.snow.deposition",
)
"""Modules and packages without Numba kernels: Numba cannot compile a wrapped function."""


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a function so that each call checks the shapes and types of its arrays.

    Dimensions of one name must have one size within a call. An array whose symbolic dimension
    ("rays+1") depends on names that no other value defines is not checked.

    Args:
        function: the annotated function; parameters and results other than arrays, unions and
            containers of arrays are not checked.

    Returns:
        The wrapped function. It raises TypeError where a value does not match its annotation.
    """
    signature = inspect.signature(function)
    annotations = {
        name: parameter.annotation
        for name, parameter in signature.parameters.items()
        if _mentions_arrays(parameter.annotation)
        and parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
    }
    result_annotation = signature.return_annotation
    checks_result = _mentions_arrays(result_annotation)
    if not annotations and not checks_result:
        return function

    def verify(values: list[tuple[str, Any, Any]]) -> None:
        """Check (name, value, annotation) triples."""
        undefined = []
        for name, value, annotation in values:
            try:
                _check(value, annotation)
            except AnnotationError:
                undefined.append((name, value, annotation))
            except TypeCheckError as error:
                raise TypeError(f"{function.__qualname__}: {name}: {error}") from None
        if len(undefined) < len(values):
            verify(undefined)  # the others may have defined the names

    @functools.wraps(function)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        values = [
            (name, value, annotations[name])
            for name, value in signature.bind(*args, **kwargs).arguments.items()
            if name in annotations
        ]
        verify(values)
        result = function(*args, **kwargs)
        if checks_result:
            verify([*values, ("result", result, result_annotation)])
        return result

    return wrapped


@contextlib.contextmanager
def unchecked() -> Iterator[None]:
    """Switch the checks off, to test how a function itself refuses a wrong shape."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", before)


def _mentions_arrays(annotation: Any) -> bool:
    if inspect.isclass(annotation) and issubclass(annotation, AbstractArray):
        return True
    return any(map(_mentions_arrays, get_args(annotation)))


def _check(value: Any, annotation: Any) -> None:
    try:
        check_type(value, annotation)
    except TypeCheckError:
        if not isinstance(value, np.generic):
            raise
        check_type(np.asarray(value), annotation)  # NumPy returns arrays of rank 0 as scalars
