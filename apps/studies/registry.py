"""The studies by name."""

from __future__ import annotations

from apps.studies import angle_assignment as dealing_table
from apps.studies import (
    area_sensors,
    flash_occlusion,
    flip_test,
    inactive_region,
    iteration_table,
    lensless_hand,
    light_field_processing,
    line_rotation,
    occlusion,
    representation,
)
from apps.studies import corrupted_measurements as spoilt_readings
from apps.studies import glossy_plate as shiny_bodies
from apps.studies import light_field_recovery as whole_light_fields
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


def find_studies(name: str) -> tuple[Study, ...]:
    """Return the study of a name, of a figure that shows its pictures, or every one for ``all``.

    Raises
    ------
    InputError
        Nothing has that name.
    """
    found = tuple(study for study in STUDIES if name in ("all", study.name, *study.aliases))
    if not found:
        known = ", ".join(word for study in STUDIES for word in (study.name, *study.aliases))
        raise InputError(f"unknown study '{name}'; take all or one of {known}")
    return found
