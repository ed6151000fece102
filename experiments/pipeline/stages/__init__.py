"""The stages from world to estimates, one a file."""
