"""The apps that come with the project: the thesis' ones, and what those that drive have in common."""
