//! Which device computes, and in which precision; chosen at run time.

use std::borrow::Cow;
use std::fmt;
use std::str::FromStr;

use burn::tensor::{DType, Device};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};

use super::EngineError;

/// What kind of device computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DeviceKind {
    /// The first GPU of those that this build knows and this machine has; this machine's processor where there is none.
    Auto,
    /// This machine's processor.
    #[default]
    Cpu,
    /// An NVIDIA GPU (builds with feature `cuda`).
    Cuda,
    /// Any GPU with a Vulkan driver (builds with feature `vulkan`).
    Vulkan,
    /// A GPU of Apple (builds with feature `metal`).
    Metal,
    /// Any GPU, also one that a program plays on the processor, through WGSL (builds with feature `wgpu`).
    Wgpu,
}

impl DeviceKind {
    const ALL: [Self; 6] = [
        Self::Auto,
        Self::Cpu,
        Self::Cuda,
        Self::Vulkan,
        Self::Metal,
        Self::Wgpu,
    ];

    /// As settings write it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
            Self::Vulkan => "vulkan",
            Self::Metal => "metal",
            Self::Wgpu => "wgpu",
        }
    }

    /// Whether there may be several, told apart by a number.
    const fn counted(self) -> bool {
        !matches!(self, Self::Auto | Self::Cpu)
    }

    /// Whether this build can use such a device.
    const fn built(self) -> bool {
        match self {
            Self::Auto | Self::Cpu => true,
            Self::Cuda => cfg!(feature = "cuda"),
            Self::Vulkan => cfg!(feature = "vulkan"),
            Self::Metal => cfg!(feature = "metal"),
            Self::Wgpu => cfg!(feature = "wgpu"),
        }
    }

    const fn hints(self) -> [&'static str; 2] {
        match self {
            Self::Auto | Self::Cpu => ["", ""],
            Self::Cuda => [
                "this program was built without NVIDIA GPUs; build with `--features cuda`, or use `cpu`",
                "this machine has no such NVIDIA GPU, or no driver for it; `cpu` always works",
            ],
            Self::Vulkan => [
                "this program was built without Vulkan; build with `--features vulkan`, or use `cpu`",
                "this machine has no such GPU with a Vulkan driver; `cpu` always works",
            ],
            Self::Metal => [
                "this program was built without Metal; build with `--features metal` on a Mac, or use `cpu`",
                "this machine has no such GPU of Apple; `cpu` always works",
            ],
            Self::Wgpu => [
                "this program was built without WGSL; build with `--features wgpu`, or use `cpu`",
                "this machine has no such GPU, and no driver that plays one (Mesa's lavapipe does); `cpu` always works",
            ],
        }
    }
}

/// Where tensors live: `cpu`, `auto`, or a kind of GPU with the number of one of several, `cuda:1`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct DeviceChoice {
    /// Which kind of device.
    pub kind: DeviceKind,
    /// Counts the devices of the kind from 0; discrete GPUs come first.
    pub index: usize,
}

impl DeviceChoice {
    /// This machine's processor.
    pub const CPU: Self = Self::first(DeviceKind::Cpu);

    /// The first device of a kind.
    #[must_use]
    pub const fn first(kind: DeviceKind) -> Self {
        Self { kind, index: 0 }
    }
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.kind.name())?;
        if self.index > 0 {
            write!(f, ":{}", self.index)?;
        }
        Ok(())
    }
}

impl FromStr for DeviceChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (name, index) = match text.split_once(':') {
            Some((name, index)) => (name, Some(index)),
            None => (text, None),
        };
        let kind = DeviceKind::ALL.into_iter().find(|kind| kind.name() == name);
        let found = kind.and_then(|kind| {
            let index = match index {
                None => 0,
                // `+1` is a number to the parser, and not one here.
                Some(digits) if kind.counted() && digits.bytes().all(|b| b.is_ascii_digit()) => {
                    digits.parse().ok()?
                }
                Some(_) => return None,
            };
            Some(Self { kind, index })
        });
        found.ok_or_else(|| {
            format!(
                "`{text}` is no device; one of auto, cpu, cuda, vulkan, metal, wgpu, a GPU also with its number: cuda:1"
            )
        })
    }
}

impl TryFrom<String> for DeviceChoice {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<DeviceChoice> for String {
    fn from(choice: DeviceChoice) -> Self {
        choice.to_string()
    }
}

impl JsonSchema for DeviceChoice {
    fn schema_name() -> Cow<'static, str> {
        "DeviceChoice".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        let names = DeviceKind::ALL.map(DeviceKind::name);
        let counted = DeviceKind::ALL.into_iter().filter(|kind| kind.counted());
        let counted: Vec<&str> = counted.map(DeviceKind::name).collect();
        let pattern = format!("^({}):[0-9]+$", counted.join("|"));
        json_schema!({
            "description": "Where tensors live: `cpu`; a kind of GPU, `cuda`, `vulkan`, `metal` or `wgpu`, with the number of one of several, \
                `cuda:1`; `auto`, the first GPU that the build knows and the machine has, or the processor.",
            "anyOf": [{ "enum": names }, { "type": "string", "pattern": pattern }],
            "x-numbered": counted,
        })
    }
}

/// What the operands of the transformer's matrix products are rounded to; sums are f32. Norms, attention, softmax, losses, codebooks,
/// weights and their gradients are always f32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// Single precision, 32 bits.
    #[default]
    F32,
    /// bfloat16, on devices that have it; the processor rounds to the same numbers, and is not faster for it.
    Bf16,
}

/// A device, and the precision of its products.
#[derive(Debug, Clone)]
pub struct Compute {
    device: Device,
    choice: DeviceChoice,
    precision: Precision,
}

impl Compute {
    /// The processor in f32: always available, and deterministic.
    #[must_use]
    pub fn cpu() -> Self {
        Self {
            device: Device::flex(),
            choice: DeviceChoice::CPU,
            precision: Precision::F32,
        }
    }

    /// The device `choice`, computing in `precision`. [`Compute::name`] says what `auto` took.
    ///
    /// # Errors
    /// When this build or this machine has no such device, or the device does not compute in `precision`.
    pub fn new(choice: DeviceChoice, precision: Precision) -> Result<Self, EngineError> {
        let found = match choice.kind {
            DeviceKind::Auto => first_gpu(),
            DeviceKind::Cpu => Some(Self::cpu()),
            _ => Some(Self::gpu(choice)?),
        };
        let found = found.unwrap_or_else(Self::cpu);
        let on_gpu = found.choice != DeviceChoice::CPU;
        if precision == Precision::Bf16 && on_gpu && !found.device.supports_dtype(DType::BF16) {
            return Err(EngineError::Precision {
                precision: "bf16",
                device: found.name(),
            });
        }
        Ok(Self { precision, ..found })
    }

    /// The same device in f32.
    #[must_use]
    pub fn in_f32(&self) -> Self {
        Self {
            precision: Precision::F32,
            ..self.clone()
        }
    }

    /// What products are computed in.
    #[must_use]
    pub fn precision(&self) -> Precision {
        self.precision
    }

    fn gpu(choice: DeviceChoice) -> Result<Self, EngineError> {
        let [not_built, not_there] = choice.kind.hints();
        let refused = |hint| EngineError::NoSuchDevice {
            device: choice.to_string(),
            hint,
        };
        if !choice.kind.built() {
            return Err(refused(not_built));
        }
        let device = found(choice.kind).into_iter().nth(choice.index);
        let device = device.ok_or_else(|| refused(not_there))?;
        Ok(Self {
            device,
            choice,
            precision: Precision::F32,
        })
    }

    /// The tensor library's handle.
    #[must_use]
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Bytes that arrays hold on the device, and what is kept for the next ones; `None` for the processor.
    #[must_use]
    pub fn memory(&self) -> Option<u64> {
        let usage = self.device.memory_pool_usage()?;
        (self.choice != DeviceChoice::CPU).then_some(usage.bytes_reserved)
    }

    /// What computes, never [`DeviceKind::Auto`].
    #[must_use]
    pub fn choice(&self) -> DeviceChoice {
        self.choice
    }

    /// What computes, for people: `cpu`, `cuda:1 (NVIDIA H100)`.
    #[must_use]
    pub fn name(&self) -> String {
        match identity(&self.device) {
            Some(part) if self.choice.kind.counted() => format!("{} ({part})", self.choice),
            _ => self.choice.to_string(),
        }
    }
}

/// A device's memory is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OutOfMemory {
    /// What was asked for, where that is known.
    pub bytes: Option<u64>,
}

impl OutOfMemory {
    /// Whether a panic of the tensor library with this text says so: the library hands such errors on as panics alone.
    #[must_use]
    pub fn said(text: &str) -> Option<Self> {
        // As `cubecl` 0.11 writes its errors.
        let asked = [
            "out of device memory allocating ",
            "can't allocate buffer of size: ",
            "Can't allocate ",
        ];
        let number = |text: &str| {
            let digits = text.split(|c: char| !c.is_ascii_digit()).next()?;
            digits.parse().ok()
        };
        let found = asked.iter().find_map(|start| text.split_once(start));
        let full = text.contains("out-of-memory error happened");
        let bytes = found.and_then(|(_, rest)| number(rest));
        (full || found.is_some()).then_some(Self { bytes })
    }
}

/// A GPU in hardware, the fastest way to it first. A program that plays one is never chosen for anybody.
fn first_gpu() -> Option<Compute> {
    use DeviceKind::{Cuda, Metal, Vulkan, Wgpu};
    let kinds = [Cuda, Metal, Vulkan, Wgpu].into_iter();
    kinds.filter(|kind| kind.built()).find_map(|kind| {
        let choice = DeviceChoice::first(kind);
        let device = found(kind).into_iter().find(is_hardware)?;
        Some(Compute {
            device,
            choice,
            precision: Precision::F32,
        })
    })
}

#[cfg(feature = "kernels")]
fn found(kind: DeviceKind) -> Vec<Device> {
    use burn::tensor::DeviceType;
    let kind = match kind {
        #[cfg(feature = "cuda")]
        DeviceKind::Cuda => DeviceType::Cuda,
        #[cfg(feature = "vulkan")]
        DeviceKind::Vulkan => DeviceType::Vulkan,
        #[cfg(feature = "metal")]
        DeviceKind::Metal => DeviceType::Metal,
        #[cfg(feature = "wgpu")]
        DeviceKind::Wgpu => DeviceType::Wgpu,
        _ => return Vec::new(),
    };
    let (mut found, played): (Vec<Device>, Vec<Device>) = Device::enumerate(kind.clone())
        .into_iter()
        .partition(is_hardware);
    // What plays a GPU is there for tests, under the one name that says so.
    if cfg!(feature = "wgpu") && is_wgpu(&kind) {
        found.extend(played);
    }
    found
}

#[cfg(feature = "wgpu")]
fn is_wgpu(kind: &burn::tensor::DeviceType) -> bool {
    *kind == burn::tensor::DeviceType::Wgpu
}

#[cfg(all(feature = "kernels", not(feature = "wgpu")))]
fn is_wgpu(_: &burn::tensor::DeviceType) -> bool {
    false
}

#[cfg(not(feature = "kernels"))]
fn found(_: DeviceKind) -> Vec<Device> {
    Vec::new()
}

/// Whether a GPU is one, and not a program.
#[cfg(any(feature = "vulkan", feature = "metal", feature = "wgpu"))]
fn is_hardware(device: &Device) -> bool {
    use burn::backend::{CubeDevice, DispatchDevice, WgpuDeviceKind};
    match device.as_dispatch() {
        DispatchDevice::Cube(CubeDevice::Wgpu(device)) => device.kind != WgpuDeviceKind::Cpu,
        _ => true,
    }
}

#[cfg(not(any(feature = "vulkan", feature = "metal", feature = "wgpu")))]
fn is_hardware(_: &Device) -> bool {
    true
}

/// What the driver calls the device.
#[cfg(feature = "kernels")]
fn identity(device: &Device) -> Option<String> {
    device.identity().map(|identity| identity.name)
}

#[cfg(not(feature = "kernels"))]
fn identity(_: &Device) -> Option<String> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_without_bf16_is_named() {
        assert!(Compute::new(DeviceChoice::CPU, Precision::Bf16).is_ok());
        // WGSL has no such numbers.
        if let Ok(gpu) = Compute::new(DeviceChoice::first(DeviceKind::Wgpu), Precision::F32) {
            let error = Compute::new(gpu.choice(), Precision::Bf16).unwrap_err();
            let message = error.to_string();
            assert!(
                message.contains("`bf16`") && message.contains("wgpu"),
                "{message}"
            );
        }
    }

    #[test]
    fn a_full_memory_is_known_by_the_words_of_the_library() {
        for (text, bytes) in [
            (
                "Err value: out of device memory allocating 1024 bytes\n0: x",
                Some(1024),
            ),
            ("can't allocate buffer of size: 77\n", Some(77)),
            (
                "Can't allocate 5 bytes: every page size the memory tracks still holds live allocations",
                Some(5),
            ),
            (
                "An out-of-memory error happened during launch\nCaused by:\n  x",
                None,
            ),
        ] {
            assert_eq!(
                OutOfMemory::said(text),
                Some(OutOfMemory { bytes }),
                "{text}"
            );
        }
        assert_eq!(OutOfMemory::said("a loss of memory"), None);
    }

    #[test]
    fn a_device_is_a_name_and_may_have_a_number() {
        for text in ["auto", "cpu", "cuda", "cuda:3", "wgpu:1", "metal", "vulkan"] {
            let choice: DeviceChoice = text.parse().unwrap();
            assert_eq!(choice.to_string(), text);
        }
        assert_eq!(
            "cuda:0".parse::<DeviceChoice>().unwrap().to_string(),
            "cuda"
        );
        for text in [
            "",
            "gpu",
            "cpu:1",
            "auto:0",
            "cuda:",
            "cuda:x",
            "cuda:+1",
            "cuda:1:2",
            "Cuda",
            "cuda:99999999999999999999",
        ] {
            let error = text.parse::<DeviceChoice>().unwrap_err();
            assert!(error.contains("cuda:1"), "{text}: {error}");
        }
    }

    #[test]
    fn a_kind_that_was_not_built_in_says_how_to_get_it() {
        for kind in DeviceKind::ALL.into_iter().filter(|kind| !kind.built()) {
            let error = Compute::new(DeviceChoice { kind, index: 1 }, Precision::F32).unwrap_err();
            let message = error.to_string();
            let feature = format!("--features {}", kind.name());
            assert!(message.contains(&feature), "{message}");
            assert!(
                message.contains(&format!("`{}:1`", kind.name())),
                "{message}"
            );
        }
    }

    #[test]
    fn a_gpu_that_the_machine_lacks_is_refused_before_anything_is_computed() {
        let built = |kind: &DeviceKind| kind.built() && kind.counted();
        for kind in DeviceKind::ALL.into_iter().filter(built) {
            let error = Compute::new(DeviceChoice { kind, index: 99 }, Precision::F32).unwrap_err();
            assert!(error.to_string().contains("no such"), "{error}");
        }
    }

    #[test]
    fn auto_always_finds_something_and_says_what() {
        let auto = DeviceChoice::first(DeviceKind::Auto);
        let taken = Compute::new(auto, Precision::F32).unwrap();
        assert_ne!(taken.choice().kind, DeviceKind::Auto);
        assert!(taken.name().starts_with(taken.choice().kind.name()));
    }
}
