"""Scenes, fields and photos that several tests share."""
