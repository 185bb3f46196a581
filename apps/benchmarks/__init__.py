"""How fast and how large this program's parts are, each held against what it cannot do without."""
