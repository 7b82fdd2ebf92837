"""Checks of a capture against itself: its photos, intrinsics, poses, points and sidecars."""
