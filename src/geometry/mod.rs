//! Rotations, rigid and similarity transforms, camera models, alignment, skeletons.
