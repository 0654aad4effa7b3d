//! Reading released weights of others without executing anything.
