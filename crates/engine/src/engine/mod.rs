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
//!   video. On the CPU each is one fused operation with a hand-written backward; on GPUs it is a kernel, or made of the library's own
//!   operations where those have a good form;
//! * [`gradients`]: gradients by parameter name, their global norm, and who hears of them while backward goes on;
//! * [`cuts`]: a graph that is cut, so that backward goes part by part;
//! * [`mod@reading`]: losses and norms that a device may not have computed yet;
//! * [`communicator`]: processes that train one model together;
//! * [`memory`]: an allocator that uses the memory of one step again in the next.

pub mod communicator;
pub mod compute;
pub mod cuts;
pub mod gradients;
pub mod initialise;
pub mod memory;
pub mod ops;
pub mod parameters;
pub mod reading;
pub mod segments;
pub mod weights;

pub use burn::tensor::{Bool, Device, Int, Tensor};
pub use communicator::{Communicator, RankError};
pub use compute::{Compute, DeviceChoice, DeviceKind, Precision};
pub use cuts::Cuts;
pub use gradients::{Complete, Gradients};
pub use initialise::Initialise;
pub use parameters::{Parameter, Parameters, parameters};
pub use reading::Reading;
pub use segments::{Segment, Segments};
pub use weights::{HostTensor, Values, Weights};

/// Why the engine refuses.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// The device asked for is none of this machine, or this program was built without its kind.
    #[error("there is no device `{device}`: {hint}")]
    NoSuchDevice {
        /// Kind and number: `cuda:0`, `vulkan:1`.
        device: String,
        /// What is lacking, and what works or helps instead.
        hint: &'static str,
    },
    /// The device cannot compute products in the precision asked for.
    #[error("the device `{device}` does not compute in `{precision}`; use `precision: f32`")]
    Precision {
        /// As it is written in settings.
        precision: &'static str,
        /// The device asked for: `cpu`, `cuda:0`, `vulkan:1`.
        device: String,
    },
    /// Weights are loaded that lack a tensor of the model.
    #[error("the weights have no tensor `{name}` of shape {expected:?}")]
    Missing {
        /// The model's name for it.
        name: String,
        /// The shape it should have.
        expected: Vec<usize>,
    },
    /// Weights are loaded that have a tensor of the model in another shape.
    #[error("tensor `{name}` has shape {found:?}, the model expects {expected:?}")]
    Shape {
        /// The tensor.
        name: String,
        /// Its shape in the weights.
        found: Vec<usize>,
        /// Its shape in the model.
        expected: Vec<usize>,
    },
    /// A tensor's elements are of another type than is asked for.
    #[error("tensor `{name}` holds {found}, the model expects {expected}")]
    Kind {
        /// The tensor.
        name: String,
        /// What the weights have: `f32`, `f64`, `i64` or `u8`.
        found: &'static str,
        /// What is asked for, by the same names.
        expected: &'static str,
    },
    /// Weights are loaded that have tensors beside those of the model: they belong to another one.
    #[error("the weights hold {count} tensors the model does not know, first `{first}`")]
    Unknown {
        /// How many names the model does not have.
        count: usize,
        /// The first of them in alphabetical order.
        first: String,
    },
    /// Weights are loaded that have a NaN or an infinite value.
    #[error("tensor `{name}` holds a value that is not finite")]
    NotFinite {
        /// The tensor.
        name: String,
    },
    /// A file of weights cannot be opened or read, or is not complete and well-formed.
    #[error("{path}: {reason}")]
    File {
        /// The file.
        path: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A file of weights cannot be written; what stood under its name before is still there.
    #[error("{path}: {error}")]
    Write {
        /// The file.
        path: String,
        /// What the operating system says.
        #[source]
        error: std::io::Error,
    },
    /// A segment lies outside the rows, or query rows overlap or do not ascend: which ones, in words.
    #[error("segments: {0}")]
    Segments(String),
}
