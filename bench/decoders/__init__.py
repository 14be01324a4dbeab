"""Every decoder fed with random inputs; the targets are in a module for each part of the project."""
