"""A live view of a fitted place in weather, in a browser on the same machine."""
