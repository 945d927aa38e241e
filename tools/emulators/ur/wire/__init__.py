"""The network interfaces of the emulated controller."""
