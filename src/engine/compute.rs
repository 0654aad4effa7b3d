//! Which device computes, and in which precision; chosen at run time.

use burn::tensor::Device;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::EngineError;

/// Where tensors live.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DeviceChoice {
    /// This machine's processor.
    #[default]
    Cpu,
    /// An NVIDIA GPU (builds with feature `cuda`).
    Cuda,
    /// Any GPU with a Vulkan driver (builds with feature `vulkan`).
    Vulkan,
}

/// In which numbers matrix products are computed: f32 for now, on every device. Norms, softmax, losses, codebooks and weights are
/// always f32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    #[default]
    F32,
    /// bfloat16: not available, no operation computes in it yet.
    Bf16,
}

/// A device that computes in f32.
#[derive(Debug, Clone)]
pub struct Compute {
    device: Device,
}

impl Compute {
    /// The processor in f32: always available, and deterministic.
    #[must_use]
    pub fn cpu() -> Self {
        Self {
            device: Device::flex(),
        }
    }

    /// The device `choice` (`index` counts the devices of one kind), computing in `precision`.
    ///
    /// # Errors
    /// When this build has no such device, or no operation computes in `precision`.
    pub fn new(
        choice: DeviceChoice,
        index: usize,
        precision: Precision,
    ) -> Result<Self, EngineError> {
        let device = match choice {
            DeviceChoice::Cpu => Device::flex(),
            DeviceChoice::Cuda => cuda(index)?,
            DeviceChoice::Vulkan => vulkan(index)?,
        };
        if precision == Precision::Bf16 {
            return Err(EngineError::Precision {
                precision: "bf16",
                device: match choice {
                    DeviceChoice::Cpu => "cpu".to_owned(),
                    DeviceChoice::Cuda => format!("cuda:{index}"),
                    DeviceChoice::Vulkan => format!("vulkan:{index}"),
                },
            });
        }
        Ok(Self { device })
    }

    /// The tensor library's handle.
    #[must_use]
    pub fn device(&self) -> &Device {
        &self.device
    }
}

#[cfg(feature = "cuda")]
#[allow(clippy::unnecessary_wraps)] // the same signature as without the feature
fn cuda(index: usize) -> Result<Device, EngineError> {
    Ok(Device::cuda(index))
}

#[cfg(not(feature = "cuda"))]
fn cuda(index: usize) -> Result<Device, EngineError> {
    Err(EngineError::NoSuchDevice {
        device: format!("cuda:{index}"),
        hint: "build with `--features cuda`",
    })
}

/// Index 0 is the best GPU there is, which may be an integrated one; others count discrete GPUs.
#[cfg(feature = "vulkan")]
#[allow(clippy::unnecessary_wraps)] // the same signature as without the feature
fn vulkan(index: usize) -> Result<Device, EngineError> {
    use burn::tensor::DeviceKind;
    Ok(Device::vulkan(match index {
        0 => DeviceKind::DefaultDevice,
        index => DeviceKind::DiscreteGpu(index),
    }))
}

#[cfg(not(feature = "vulkan"))]
fn vulkan(index: usize) -> Result<Device, EngineError> {
    Err(EngineError::NoSuchDevice {
        device: format!("vulkan:{index}"),
        hint: "build with `--features vulkan`",
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bf16_is_refused_by_name_with_the_device() {
        let error = Compute::new(DeviceChoice::Cpu, 0, Precision::Bf16).unwrap_err();
        let message = error.to_string();
        assert!(
            message.contains("`bf16`") && message.contains("`cpu`"),
            "{message}"
        );
    }

    #[cfg(not(feature = "cuda"))]
    #[test]
    fn a_missing_device_says_how_to_get_it() {
        let error = Compute::new(DeviceChoice::Cuda, 1, Precision::F32).unwrap_err();
        assert!(error.to_string().contains("--features cuda"), "{error}");
    }
}
