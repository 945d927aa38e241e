"""Touching and following a seam: contact, steering laws, guards and the servo's step."""
