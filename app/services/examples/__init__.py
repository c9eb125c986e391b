"""The examples that come with the program: tables with goals, and their recorded stories."""
