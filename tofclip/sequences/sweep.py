"""Parameter sweeps: every combination of some settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

from tofclip.errors import InputError
from tofclip.sequences.recovering import RecoverySettings

PARAMETER_TYPES = {"method": str, "iterations": int, "weight": float, "focus": str}
"""Settings that can be swept, and what their values are."""


def expand_sweep(
    recovery: RecoverySettings, values: Mapping[str, Sequence[str]]
) -> dict[str, RecoverySettings]:
    """Return a recovery for every combination of values, by a name that can be a folder's.

    Parameters
    ----------
    recovery : RecoverySettings
        Has the settings that are not swept.
    values : mapping of str to sequence of str
        Values of ``method``, ``iterations``, ``weight`` and ``focus``.

    Returns
    -------
    dict of str to RecoverySettings

    Raises
    ------
    InputError
        No such setting, no such value, or a combination that does not exist, such as iterations of
        ``linear``.
    """
    unknown = [name for name in values if name not in PARAMETER_TYPES]
    if unknown:
        raise InputError(f"'{unknown[0]}' cannot be swept; take {', '.join(PARAMETER_TYPES)}")
    found = {}
    for chosen in product(*values.values()):
        named = dict(zip(values, chosen, strict=True))
        try:
            settings = {name: PARAMETER_TYPES[name](value) for name, value in named.items()}
        except ValueError as fault:
            raise InputError(f"sweep: {fault}") from fault
        label = ",".join(f"{name}={value}" for name, value in named.items())
        # The new object checks the combination, so that none is refused after hours of others.
        found[label] = replace(recovery, **settings)
    return found
