"""Hamamatsu's streak cameras, through RemoteEx: the TCP remote control of HPD-TA and HiPic."""
