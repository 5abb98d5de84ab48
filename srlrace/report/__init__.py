"""Tables, intervals and figures made from run folders; reads files only and needs no torch."""
