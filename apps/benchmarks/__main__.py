"""One case at one size: ``python -m apps.benchmarks CASE SIZE`` prints its figures as JSON."""

from __future__ import annotations

import json
import sys

from apps.benchmarks.harness import measure_case
from apps.benchmarks.registry import find_cases


def main() -> None:
    """Measure what the command line names."""
    name, size = sys.argv[1:]
    print(json.dumps(measure_case(find_cases(name)[0], int(size))))


if __name__ == "__main__":
    main()
