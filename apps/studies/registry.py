"""The studies by name."""

from __future__ import annotations

from apps.studies import (
    area_sensors,
    dealing_table,
    flash_occlusion,
    flip_test,
    inactive_region,
    iteration_table,
    lensless_hand,
    light_field_processing,
    line_rotation,
    occlusion,
    representation,
    shiny_bodies,
    spoilt_readings,
    whole_light_fields,
)
from apps.studies.outcome import Study
from tofclip.errors import InputError

STUDIES: tuple[Study, ...] = (
    iteration_table.STUDY,
    flip_test.STUDY,
    *whole_light_fields.STUDIES,
    *spoilt_readings.STUDIES,
    occlusion.STUDY,
    flash_occlusion.STUDY,
    inactive_region.STUDY,
    *representation.STUDIES,
    area_sensors.STUDY,
    lensless_hand.STUDY,
    line_rotation.STUDY,
    shiny_bodies.STUDY,
    light_field_processing.STUDY,
    dealing_table.STUDY,
)


def studies_called(name: str) -> tuple[Study, ...]:
    """Return the study of a name, of a figure that shows its pictures, or every one for ``all``.

    Raises
    ------
    InputError
        Nothing has that name.
    """
    found = tuple(study for study in STUDIES if name in ("all", study.name, *study.also))
    if not found:
        known = ", ".join(word for study in STUDIES for word in (study.name, *study.also))
        raise InputError(f"unknown study '{name}'; take all or one of {known}")
    return found
