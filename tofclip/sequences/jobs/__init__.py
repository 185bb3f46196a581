"""Many independent jobs, here or on the workers of a cluster (dask.distributed).

A job carries names of files and numbers, never arrays; it reads its input and writes its result itself, once and
whole. What is known to be finished is not done again, so that a run that was stopped goes on where it was.
"""

from tofclip.sequences.jobs.folder import claim
from tofclip.sequences.jobs.jobs import Failure, Job, Report, Summary, unfinished
from tofclip.sequences.jobs.run import run

__all__ = ["Failure", "Job", "Report", "Summary", "claim", "run", "unfinished"]
