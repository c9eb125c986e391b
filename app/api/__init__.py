"""The REST service: app factory, routes with their schemas, problems, security, the viewer relay."""
