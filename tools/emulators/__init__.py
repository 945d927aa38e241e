"""Emulated devices that run in processes of their own."""
