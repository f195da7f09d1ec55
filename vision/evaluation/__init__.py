"""Evaluation of a detector on labelled images: data set readers and the sheet of worst errors."""
