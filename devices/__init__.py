"""The USB layer that talks to streak and SPAD hardware. Not written yet: nothing here touches a device."""
