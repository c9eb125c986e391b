"""The method as published, module by module.

docs/explanation/paper.md lists the choices and deviations, each module its own.
"""
