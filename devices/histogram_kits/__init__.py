"""Evaluation kits that send a histogram for each of a few zones as lines of text over USB: TMF8828
(ams OSRAM) and VL53L8CH (ST).
"""
