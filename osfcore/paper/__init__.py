"""The method as published, module by module; docs/paper.md tells the choices and deviations, each module its own."""
