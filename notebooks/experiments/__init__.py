"""The experiments of the book: from cells to rows, and from rows to tables, figures and films.

The only room of the house that reads or writes ``data/``. What is true of an algorithm is in
:mod:`ipo`; here is how often it was run, with what, where the rows are, and how they are shown.
"""
