"""The method as published, module by module; docs/paper.md tells every reading of the text and every deviation."""
