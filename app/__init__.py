"""The program around the core: command line, service, viewer, dashboard."""
