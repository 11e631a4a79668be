"""What a program can ask of a bench: each function computes and returns, and prints nothing.

The commands are built on it, and `import bench` offers the part that a notebook needs.
"""
