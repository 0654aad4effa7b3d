//! Gradients added from GPU to GPU, through NVIDIA's NCCL.
//!
//! NCCL is loaded when it is asked for; neither this build nor a machine without it knows of it. Its sums have the order that it
//! chooses for the machine: the same bytes from run to run on the same GPUs, as NVIDIA says, and not those of the processor.

use super::{DeviceLink, RankError};
use crate::engine::Compute;
use burn::backend::{CubeDevice, DispatchDevice};
use burn::tensor::Tensor;
use burn_cubecl::CubeBackend;
use cubecl::cuda::CudaRuntime;
use cubecl_runtime::runtime::Runtime;
use cudarc::driver::{CudaContext, CudaStream};
use cudarc::nccl::{result, sys};
use std::ffi::c_char;
use std::mem::MaybeUninit;
use std::sync::{Arc, Mutex, PoisonError};

/// One rank and its GPU, joined with those of the others.
pub(super) struct Nccl {
    rank: usize,
    size: usize,
    /// Of its own, so that what is computed meanwhile goes on.
    stream: Arc<CudaStream>,
    joined: Mutex<Joined>,
}

struct Joined(sys::ncclComm_t);

// SAFETY: the pointer is used behind a mutex alone, and NCCL asks for no particular thread, only for one at a time.
#[allow(unsafe_code)]
unsafe impl Send for Joined {}

impl Drop for Joined {
    fn drop(&mut self) {
        // SAFETY: the pointer came from `comm_init_rank`, and nobody has it any more. What is left to do is not waited for: where a
        // rank is lost it would never come.
        #[allow(unsafe_code)]
        let _ = unsafe { result::comm_abort(self.0) };
    }
}

impl Nccl {
    /// What the ranks find each other by, from rank 0; nothing on the others. Or why this rank cannot.
    pub(super) fn prepare(root: bool) -> Result<Vec<u8>, String> {
        // SAFETY: it only tries to load the library.
        #[allow(unsafe_code)]
        let found = unsafe { sys::is_culib_present() };
        if !found {
            return Err("there is no NCCL (`libnccl.so`) here".to_owned());
        }
        if !root {
            return Ok(Vec::new());
        }
        let id = result::get_uniqueid().map_err(|error| refused("an identifier", &error))?;
        Ok(id.internal.iter().map(|byte| *byte as u8).collect())
    }

    /// Joins the others, who all do so now, with the identifier of rank 0.
    pub(super) fn join(
        id: &[u8],
        rank: usize,
        size: usize,
        compute: &Compute,
    ) -> Result<Self, String> {
        let id: Vec<c_char> = id.iter().map(|byte| *byte as c_char).collect();
        let internal: [c_char; 128] = id.try_into().map_err(|_| "rank 0 sent no identifier")?;
        let device = match compute.device().as_dispatch() {
            DispatchDevice::Cube(CubeDevice::Cuda(device)) => device.index,
            _ => return Err("it computes on no GPU of NVIDIA".to_owned()),
        };
        // The device's primary context, which the tensor library computes in too.
        let context = CudaContext::new(device).map_err(|error| error.to_string())?;
        let stream = context.new_stream().map_err(|error| error.to_string())?;
        let mut joined = MaybeUninit::uninit();
        let id = sys::ncclUniqueId { internal };
        // SAFETY: the pointer is to memory of our own, and read only when the call has filled it.
        #[allow(unsafe_code)]
        let joined = unsafe {
            result::comm_init_rank(joined.as_mut_ptr(), size as i32, id, rank as i32)
                .map_err(|error| refused("a group", &error))?;
            joined.assume_init()
        };
        Ok(Self {
            rank,
            size,
            stream,
            joined: Mutex::new(Joined(joined)),
        })
    }

    /// As NVIDIA writes it: `2.27.5`.
    pub(super) fn version() -> String {
        let version = result::get_nccl_version().unwrap_or_default();
        let (major, minor, patch) = (version / 10_000, version / 100 % 100, version % 100);
        format!("{major}.{minor}.{patch}")
    }

    fn failed(&self, reason: String) -> RankError {
        RankError {
            rank: self.rank,
            size: self.size,
            host: String::new(),
            reason,
        }
    }
}

fn refused(what: &str, error: &result::NcclError) -> String {
    format!("NCCL refused {what} ({:?})", error.0)
}

impl DeviceLink for Nccl {
    fn sum(&self, values: Tensor<1>) -> Result<Tensor<1>, RankError> {
        let count = values.dims()[0];
        let device = values.device();
        let sum = Tensor::<1>::empty([count], &device);
        // The server keeps both arrays where they are while their places are held.
        let place = |array: Tensor<1>| {
            let array = array
                .try_into_primitive::<CubeBackend>()
                .map_err(|error| self.failed(format!("{error:?}")))?;
            let array = burn_cubecl::kernel::into_contiguous(array);
            let found = array
                .client
                .get_resource::<<CudaRuntime as Runtime>::Server>(array.handle.clone());
            found.map_err(|error| self.failed(error.to_string()))
        };
        let (from, to) = (place(values)?, place(sum.clone())?);
        // NCCL's stream knows nothing of what fills these arrays, and of what used their memory before.
        let synced = device.sync();
        synced.map_err(|error| self.failed(format!("{error:?}")))?;
        let context = self.stream.context();
        let bound = context.bind_to_thread();
        bound.map_err(|error| self.failed(error.to_string()))?;
        let joined = self.joined.lock().unwrap_or_else(PoisonError::into_inner);
        // SAFETY: both places hold `count` numbers on this rank's device until `from` and `to` go, and the stream is waited for
        // before; nothing else writes there, since `sum` is known to nobody yet.
        #[allow(unsafe_code)]
        let asked = unsafe {
            result::all_reduce(
                from.resource().ptr as *const _,
                to.resource().ptr as *mut _,
                count,
                sys::ncclDataType_t::ncclFloat32,
                sys::ncclRedOp_t::ncclSum,
                joined.0,
                self.stream.cu_stream().cast(),
            )
        };
        asked.map_err(|error| self.failed(refused("a sum", &error)))?;
        let done = self.stream.synchronize();
        done.map_err(|error| self.failed(error.to_string()))?;
        Ok(sum)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::parameters::to_host;
    use crate::engine::{DeviceChoice, DeviceKind, Precision};
    use burn::tensor::TensorData;

    #[test]
    fn one_rank_of_nccl_gives_back_what_it_was_given() {
        let choice = DeviceChoice::first(DeviceKind::Cuda);
        let compute = match Compute::new(choice, Precision::F32) {
            Ok(compute) => compute,
            Err(error) => return eprintln!("skipped: one rank of NCCL: {error}"),
        };
        let id = match Nccl::prepare(true) {
            Ok(id) => id,
            Err(why) => return eprintln!("skipped: one rank of NCCL: {why}"),
        };
        let nccl = Nccl::join(&id, 0, 1, &compute).unwrap();
        for length in [1, 1000, 3_000_000] {
            let values: Vec<f32> = (0..length).map(|i| (i as f32 * 0.37).sin()).collect();
            let data = TensorData::new(values.clone(), [length]);
            let array = Tensor::from_data(data, compute.device()) * 2.0;
            let sum = nccl.sum(array).unwrap() + 1.0;
            let expected: Vec<f32> = values.iter().map(|value| value * 2.0 + 1.0).collect();
            assert_eq!(to_host(sum), expected);
        }
    }
}
