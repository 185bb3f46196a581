"""Which instants of a shot hold light: most of a flash's rows hold none, and need no recovery."""
