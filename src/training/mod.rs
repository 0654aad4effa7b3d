//! Training that can be trusted: step, schedule, optimizer, checkpoints (Supp. B).
