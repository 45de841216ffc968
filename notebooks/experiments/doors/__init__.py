"""Door opening: training, what policies open and how, tables, figures and films of the chapter."""
