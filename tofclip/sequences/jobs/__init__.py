"""Many independent jobs, here or on the workers of a cluster (dask.distributed).

A job carries names of files and numbers, never arrays; it reads its input and writes its result
itself, once and whole. What is known to be finished is not done again, so that a run that was
stopped goes on where it was.
"""

from tofclip.sequences.jobs.jobs import Failure, Job, Report, Summary, run_jobs, select_unfinished
from tofclip.sequences.jobs.output_folder import lock_output_folder

__all__ = [
    "Failure",
    "Job",
    "Report",
    "Summary",
    "lock_output_folder",
    "run_jobs",
    "select_unfinished",
]
