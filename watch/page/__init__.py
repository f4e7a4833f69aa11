"""The live page: a running bench in a browser."""
