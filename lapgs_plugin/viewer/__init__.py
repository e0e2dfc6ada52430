"""`lapgs view`: a run in a web browser, band by band. The page itself is viser's; the pictures are rendered here."""
