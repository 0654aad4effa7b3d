//! Gradients that never leave the devices: who can do that, and what is said where they cannot.

use super::reduce::Reduction;
use super::{Communicator, RankError};
use crate::engine::Compute;
#[cfg(feature = "cuda")]
use std::sync::Arc;

impl Communicator {
    /// The same ranks for a training on this device: where all of them compute on GPUs of NVIDIA and have NCCL, gradients are added
    /// from GPU to GPU. Beside them a sentence that says how gradients travel, where there is a choice. All ranks must be here.
    ///
    /// # Errors
    /// When a rank is lost.
    pub fn on(
        self,
        compute: &Compute,
        reduction: Reduction,
    ) -> Result<(Self, Option<String>), RankError> {
        #[cfg(feature = "cuda")]
        if self.size() > 1 {
            return self.between_gpus(compute, reduction);
        }
        let _ = (compute, reduction);
        Ok((self, None))
    }

    #[cfg(feature = "cuda")]
    fn between_gpus(
        mut self,
        compute: &Compute,
        reduction: Reduction,
    ) -> Result<(Self, Option<String>), RankError> {
        use super::nccl::Nccl;
        use crate::engine::DeviceKind;
        let on_cuda = compute.choice().kind == DeviceKind::Cuda;
        let through_host = |why: &str| {
            let sentence = format!("gradients travel through the host and MPI: {why}");
            on_cuda.then_some(sentence)
        };
        if reduction == Reduction::Ordered {
            return Ok((self, through_host("`reduction: ordered` is added there")));
        }
        // All join, or none does: who joins alone waits for ever.
        let ready = if on_cuda {
            Nccl::prepare(self.is_root())
        } else {
            Err("it computes on no GPU of NVIDIA".to_owned())
        };
        let id = match self.all_can(ready)? {
            Ok(mut told) => told.swap_remove(0),
            Err(why) => return Ok((self, through_host(&why))),
        };
        let joined = Nccl::join(&id, self.rank(), self.size(), compute);
        if let Err(why) = self.all_can(joined.as_ref().map(|_| Vec::new()).map_err(Clone::clone))? {
            return Ok((self, through_host(&why)));
        }
        self.devices = joined.ok().map(|link| Arc::new(link) as _);
        let how = format!(
            "gradients travel from GPU to GPU through NCCL {}",
            Nccl::version()
        );
        Ok((self, Some(how)))
    }

    /// What every rank tells, or which one cannot, and why: the same on all of them.
    #[cfg(feature = "cuda")]
    fn all_can(
        &self,
        mine: Result<Vec<u8>, String>,
    ) -> Result<Result<Vec<Vec<u8>>, String>, RankError> {
        let told = serde_json::to_vec(&mine).map_err(|error| error.to_string());
        let told = self.gather(told)?;
        let read = |(rank, bytes): (usize, &Vec<u8>)| {
            let told: Result<Vec<u8>, String> =
                serde_json::from_slice(bytes).map_err(|error| self.odd(rank, &error))?;
            Ok(told.map_err(|why| format!("rank {rank} of {}: {why}", self.size())))
        };
        let told: Result<Vec<_>, RankError> = told.iter().enumerate().map(read).collect();
        Ok(told?.into_iter().collect())
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::on_ranks;
    use super::*;

    #[test]
    fn ranks_on_processors_keep_their_way_and_nothing_is_said() {
        for reduction in [Reduction::Fast, Reduction::Ordered] {
            let found = on_ranks(2, |ranks| {
                let (ranks, how) = ranks.on(&Compute::cpu(), reduction).unwrap();
                (ranks.devices.is_none(), how, ranks.size())
            });
            assert_eq!(found, [(true, None, 2), (true, None, 2)]);
        }
    }
}
