"""The native engine beside the exact one: accuracy and cost."""
