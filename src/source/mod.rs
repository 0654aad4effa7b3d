//! Where clips come from: videos, recordings, datasets and the built-in synthetic world (Sec. 3, Table 1).
