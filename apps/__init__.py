"""What people run: the console program `tofclip` and the pictures that it draws."""
