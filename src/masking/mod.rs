//! Masking policies: which tokens are seen, which are asked for (Sec. 4.3, Alg. 1).
