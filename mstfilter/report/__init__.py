"""What a run looks like: pictures, figures, one self-contained HTML page, and exports. Stands on the run folder."""
