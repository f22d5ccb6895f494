"""Run rows of a finished sweep again and demand the same outcomes: are committed numbers those of this code?"""
