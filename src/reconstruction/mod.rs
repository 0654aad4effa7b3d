//! From decoded signals to a metric reconstruction of a whole video (Sec. 4.1, Supp. D).

pub mod predictions;
