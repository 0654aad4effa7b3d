//! Metrics, statistics and tables (Sec. 5).
