//! Container formats that carry arrays: zip, npy and npz, read with bounded memory.
