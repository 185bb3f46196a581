"""How fast and how large this program's parts are, each held against what it cannot do without.

`tofclip bench` runs every case of `apps.benchmarks.registry` in fresh processes; `python -m
apps.benchmarks CASE SIZE` is one of them.
"""
