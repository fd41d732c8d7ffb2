"""What holds for the settings of every stage: numbers are finite, and lie where they mean something."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import fields
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

TEXT = "utf-8-sig"
"""Encoding of text files from elsewhere: UTF-8, which editors on Windows begin with a mark."""


def check_finite(config: DataclassInstance, unbounded: Collection[str] = ()) -> None:
    """Refuse settings with a number, or a tuple with a number, that is NaN or infinite.

    What is no plain number, such as an array that JAX traces, is passed over.

    Args:
        config: the settings.
        unbounded: names of fields that may be infinite.

    Raises:
        ValueError: names the field.
    """
    for field in fields(config):
        value = getattr(config, field.name)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not math.isfinite(number):
                if field.name in unbounded and not math.isnan(number):
                    continue
                raise ValueError(f"{field.name} must be a finite number, got {number}")


def check_within(config: DataclassInstance, low: float, high: float, names: Collection[str]) -> None:
    """Refuse settings whose plain numbers do not lie between two, both included.

    Raises:
        ValueError: names the field.
    """
    for name in names:
        value = getattr(config, name)
        if isinstance(value, int | float) and not low <= value <= high:
            raise ValueError(f"{name} must lie within {low:g} and {high:g}, got {value:g}")
