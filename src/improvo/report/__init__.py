"""Everything a person looks at: pictures, HTML pages, the live viewer."""
