"""The catalogue of many run folders: an SQL index that can be deleted and rebuilt, and queries on it."""
