"""The Keysight Truevolt meters 34460A, 34461A, 34465A, 34470A."""
