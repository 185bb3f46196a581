"""What emulated instruments share: a USB of software and faults to order; and Aravis' own emulated
camera. Emulations of one instrument are beside its driver.

The drivers do not know the difference; all of their code runs.
"""
