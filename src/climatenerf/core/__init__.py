"""What every part of the program shares: samples, cameras, colour, classes, files, errors."""
