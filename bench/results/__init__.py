"""Results of the commands: typed models, which give JSON and schema, and their text, pages and plots."""
