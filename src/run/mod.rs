//! Running a planned graph: the run directory, the content-addressed cache, locks and the record.
