//! Iterative parallel decoding: schedules, guidance, nucleus sampling, samplers (Supp. C).
