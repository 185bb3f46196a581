"""Carrying what a wall of any shape recorded onto a plane before the hidden scene."""
