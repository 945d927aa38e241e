"""Touches and follows a seam: settings, contact, steering laws, guards and the servo's step."""
