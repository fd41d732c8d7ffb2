"""Pages and charts that say what runs found: one HTML file that needs no network. Built by `page.Page`."""
