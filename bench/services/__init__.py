"""The functions behind the commands and `import bench`: they compute and return results, and print nothing."""
