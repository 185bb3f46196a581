"""Studies of the paper's supplement, on simulated scenes: what `docs/nlos.md` reports."""
