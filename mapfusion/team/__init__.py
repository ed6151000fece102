"""Robots that exchange their maps while they drive."""
