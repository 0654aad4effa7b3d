//! Layers shared by the tokenizers and MGET.
