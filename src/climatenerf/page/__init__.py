"""One HTML page that shows a place in weather, and needs neither a server nor a network."""
