"""Does the test against chance refuse maps without common ground, and only those?"""
