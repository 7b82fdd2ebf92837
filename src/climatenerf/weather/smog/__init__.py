"""Smog, fog and haze: a medium that absorbs and glows."""
