"""The request handlers of the pages, their forms and their scripts."""
