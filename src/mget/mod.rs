//! The Masked Generative Egocentric Transformer (Sec. 4.3, Supp. B).
