"""The paper's figures and tables, measured again: ``python -m examples.studies.paper``."""
