"""How a process of this program is started from another one of it."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def prepare_module_run(module: str, *arguments: str) -> tuple[list[str], dict[str, str]]:
    """Return the command, and its environment, that runs a module of this program.

    It is the module of the program that runs, also where another one lies in the folder that the
    user is in, such as a checkout beside what was installed from it.

    Parameters
    ----------
    module : str
        Full name.
    *arguments : str

    Returns
    -------
    command : list of str
    environment : dict
    """
    root = str(Path(__file__).resolve().parents[1])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    # -P: no packages of the user's folder
    command = [sys.executable, "-P", "-m", module, *arguments]
    return command, {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
