//! The seam to the tensor library: device, precision, fused operations, parameter files.
//!
//! Everything above this room computes with [`Tensor`] and the operations of [`ops`], and never names a back end. Read in
//! this order:
//!
//! * [`compute`]: which device, which precision, chosen at run time;
//! * [`mod@parameters`]: how a model holds its numbers, and how they are named, counted, loaded and stored;
//! * [`weights`]: named arrays on the host and the safetensors files they live in;
//! * [`initialise`]: where the numbers of a new model come from;
//! * [`ops`]: linear, layer norm, attention over packed segments, GELU, SwiGLU, cross-entropy, convolution and frame norm of
//!   video. On the CPU each is one fused operation with a hand-written backward; on other back ends it is unfused of the
//!   library's own operations. Nearest code is a search on the host; embedding is the library's select everywhere;
//! * [`gradients`]: gradients by parameter name, their global norm;
//! * [`communicator`]: processes that train one model together;
//! * [`memory`]: an allocator that uses the memory of one step again in the next.

pub mod communicator;
pub mod compute;
pub mod gradients;
pub mod initialise;
pub mod memory;
pub mod ops;
pub mod parameters;
pub mod segments;
pub mod weights;

pub use burn::tensor::{Bool, Device, Int, Tensor};
pub use communicator::{Communicator, RankError};
pub use compute::{Compute, DeviceChoice, DeviceKind, Precision};
pub use gradients::Gradients;
pub use initialise::Initialise;
pub use parameters::{Parameter, Parameters, parameters};
pub use segments::{Segment, Segments};
pub use weights::{HostTensor, Values, Weights};

/// Why the engine refuses.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    #[error("there is no device `{device}`: {hint}")]
    NoSuchDevice { device: String, hint: &'static str },
    #[error("the device `{device}` does not compute in `{precision}`; use `precision: f32`")]
    Precision {
        precision: &'static str,
        device: String,
    },
    #[error("the weights have no tensor `{name}` of shape {expected:?}")]
    Missing { name: String, expected: Vec<usize> },
    #[error("tensor `{name}` has shape {found:?}, the model expects {expected:?}")]
    Shape {
        name: String,
        found: Vec<usize>,
        expected: Vec<usize>,
    },
    #[error("tensor `{name}` holds {found}, the model expects {expected}")]
    Kind {
        name: String,
        found: &'static str,
        expected: &'static str,
    },
    #[error("the weights hold {count} tensors the model does not know, first `{first}`")]
    Unknown { count: usize, first: String },
    #[error("tensor `{name}` holds a value that is not finite")]
    NotFinite { name: String },
    #[error("{path}: {reason}")]
    File { path: String, reason: String },
    #[error("{path}: {error}")]
    Write {
        path: String,
        #[source]
        error: std::io::Error,
    },
    #[error("segments: {0}")]
    Segments(String),
}
