//! The Masked Generative Egocentric Transformer (Sec. 4.3, Supp. B).
//!
//! Read in this order: [`size`] and [`spec`] (what a model is made of, and every parameter by name), [`positions`] (the fixed
//! codes), [`batch`] (packed tokens), [`model`] (**the forward pass, top to bottom**), [`embedding`] (how modalities enter and
//! leave), [`loss`], `activation_checkpointing` (gradients in little memory), `backward_in_parts` (gradients that are sent while
//! others are computed), [`names`] (the release's names of our parameters).

mod activation_checkpointing;
mod backward_in_parts;
pub mod batch;
mod embedding;
pub mod loss;
pub mod model;
pub mod names;
pub mod positions;
pub mod size;
pub mod spec;
pub mod stored;

pub use batch::{Batch, BatchError, Content, EncoderInput, Sequence, Targets, Values};
pub use loss::{Loss, LossValues, Losses};
pub use model::{Context, Mget};
pub use positions::Positions;
pub use size::Size;
pub use spec::{Input, MgetSpec, ModalitySpec, SpecError};
pub use stored::StoredError;
