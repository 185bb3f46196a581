"""SPAD arrays that are read over TCP, with the commands of Pi Imaging's SPAD512S."""
