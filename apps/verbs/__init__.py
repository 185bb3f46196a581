"""The verbs of `tofclip`, one module each. What a verb needs is imported when it runs."""
