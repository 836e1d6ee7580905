"""The native engine compared with the exact one: accuracy and cost."""
