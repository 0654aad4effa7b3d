//! Who started this process, and as which of how many.
//!
//! Nothing of MPI is touched where a process was started by itself.

use super::{Communicator, WORLD};

/// What a launcher says of the process it started.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Launched {
    /// From 0.
    pub rank: usize,
    /// How many processes it started.
    pub size: usize,
    /// The rank among those of this machine.
    pub local_rank: usize,
    /// How many of them are on this machine.
    pub local_size: usize,
    /// Its name: `mpirun`, `srun`.
    pub by: &'static str,
}

/// Why processes that were started together cannot work together.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LaunchError {
    /// A launcher started several processes of a program that was built without MPI.
    #[error(
        "`{by}` started {size} processes, but this build of `reviv` knows no MPI and would run the experiment {size} times"
    )]
    NotBuilt {
        /// The launcher, by the program's name.
        by: &'static str,
        /// How many processes it started.
        size: usize,
    },
    /// The launcher and MPI disagree about the number of processes.
    #[error("`{by}` started {size} processes, but MPI sees {found}")]
    Apart {
        /// The launcher, by the program's name.
        by: &'static str,
        /// How many processes it started.
        size: usize,
        /// How many MPI sees.
        found: usize,
    },
    /// MPI's own reason.
    #[error("MPI did not start: {0}")]
    Mpi(String),
}

impl LaunchError {
    /// The way out.
    #[must_use]
    pub fn help(&self) -> &'static str {
        match self {
            Self::NotBuilt { .. } => {
                "build it with `--features mpi` (docs/guide/cluster.md), start one process, or give each its own `--shard i/n`"
            }
            Self::Apart { .. } => {
                "the launcher and the library are of different MPIs: `srun --mpi=pmix`, or the `mpirun` of the library"
            }
            Self::Mpi(_) => "`mpirun -n 2 hostname` shows whether MPI works on this machine",
        }
    }
}

/// What the environment says of a launcher; `get` reads a variable. `None`: started by itself, or as the only one.
pub fn launched(get: impl Fn(&str) -> Option<String>) -> Option<Launched> {
    // Inside a job script of SLURM its own variables speak of the job; only those of a step speak of this process.
    let known = [
        (
            "mpirun",
            "OMPI_COMM_WORLD_SIZE",
            "OMPI_COMM_WORLD_RANK",
            ["OMPI_COMM_WORLD_LOCAL_RANK", "OMPI_COMM_WORLD_LOCAL_SIZE"],
        ),
        (
            "srun",
            "SLURM_STEP_NUM_TASKS",
            "SLURM_PROCID",
            ["SLURM_LOCALID", "SLURM_STEP_TASKS_PER_NODE"],
        ),
        (
            "mpiexec",
            "PMI_SIZE",
            "PMI_RANK",
            ["MPI_LOCALRANKID", "MPI_LOCALNRANKS"],
        ),
    ];
    // `2(x3)` is SLURM's two tasks on each of three nodes.
    let number = |name: &str| -> Option<usize> {
        let value = get(name)?;
        let digits = value.split(|c: char| !c.is_ascii_digit()).next()?;
        digits.parse().ok()
    };
    known.into_iter().find_map(|(by, size, rank, local)| {
        let size = number(size).filter(|size| *size > 1)?;
        Some(Launched {
            rank: number(rank)?,
            size,
            local_rank: number(local[0]).unwrap_or(0),
            local_size: number(local[1]).unwrap_or(1),
            by,
        })
    })
}

/// What this process was started as.
#[must_use]
pub fn here() -> Option<Launched> {
    launched(|name| std::env::var(name).ok())
}

/// Joins the processes that were started with this one; alone where there are none. `tell` says why a job is ended that cannot
/// be ended in an orderly way. From then on [`Communicator::world`] is what this returns.
///
/// # Errors
/// When there are others, and this build or the machine cannot reach them.
pub fn launch(tell: fn(&super::RankError)) -> Result<Communicator, LaunchError> {
    let Some(launched) = here() else {
        return Ok(Communicator::alone());
    };
    let world = join(&launched, tell)?;
    share_cores(&launched);
    Ok(WORLD.get_or_init(|| world).clone())
}

/// Ranks of one machine share its cores, unless the launcher has bound them already. Results do not depend on it.
fn share_cores(launched: &Launched) {
    let bound = std::thread::available_parallelism().map_or(1, usize::from);
    let all = std::fs::read_to_string("/proc/cpuinfo").map_or(0, |text| {
        text.lines()
            .filter(|line| line.starts_with("processor"))
            .count()
    });
    if std::env::var_os("RAYON_NUM_THREADS").is_none() && bound >= all {
        let threads = (bound / launched.local_size.max(1)).max(1);
        // A pool that exists already keeps its size: more threads than cores, and the same results.
        let _ = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build_global();
    }
}

#[cfg(not(feature = "mpi"))]
fn join(launched: &Launched, _: fn(&super::RankError)) -> Result<Communicator, LaunchError> {
    Err(LaunchError::NotBuilt {
        by: launched.by,
        size: launched.size,
    })
}

#[cfg(feature = "mpi")]
fn join(launched: &Launched, tell: fn(&super::RankError)) -> Result<Communicator, LaunchError> {
    use super::Link as _;
    let patience = std::env::var(PATIENCE).ok();
    let patience = patience.and_then(|text| text.parse().ok());
    let link = super::mpi::Mpi::start(launched.local_rank, patience.unwrap_or(25.0), tell)
        .map_err(LaunchError::Mpi)?;
    if link.size() != launched.size {
        return Err(LaunchError::Apart {
            by: launched.by,
            size: launched.size,
            found: link.size(),
        });
    }
    Ok(Communicator::of(std::sync::Arc::new(link)))
}

/// Seconds that a rank may be silent, or behind the others in a step.
#[cfg(feature = "mpi")]
const PATIENCE: &str = "REVIV_PATIENCE";

#[cfg(test)]
mod tests {
    use super::*;

    fn found(variables: &[(&str, &str)]) -> Option<(usize, usize, usize, usize, &'static str)> {
        let get = |name: &str| {
            let mut all = variables.iter();
            all.find(|(known, _)| *known == name)
                .map(|(_, value)| (*value).to_owned())
        };
        launched(get).map(|l| (l.rank, l.size, l.local_rank, l.local_size, l.by))
    }

    #[test]
    fn launchers_are_known_by_their_variables() {
        let mpirun = [
            ("OMPI_COMM_WORLD_SIZE", "8"),
            ("OMPI_COMM_WORLD_RANK", "5"),
            ("OMPI_COMM_WORLD_LOCAL_RANK", "1"),
            ("OMPI_COMM_WORLD_LOCAL_SIZE", "4"),
        ];
        assert_eq!(found(&mpirun), Some((5, 8, 1, 4, "mpirun")));
        let srun = [
            ("SLURM_STEP_NUM_TASKS", "6"),
            ("SLURM_PROCID", "3"),
            ("SLURM_LOCALID", "1"),
            ("SLURM_STEP_TASKS_PER_NODE", "2(x3)"),
        ];
        assert_eq!(found(&srun), Some((3, 6, 1, 2, "srun")));
        let hydra = [("PMI_SIZE", "2"), ("PMI_RANK", "1")];
        assert_eq!(found(&hydra), Some((1, 2, 0, 1, "mpiexec")));
        // A job script of SLURM is one process, whatever the job has asked for; one process is alone.
        assert_eq!(found(&[("SLURM_NTASKS", "8"), ("SLURM_PROCID", "0")]), None);
        assert_eq!(
            found(&[("OMPI_COMM_WORLD_SIZE", "1"), ("OMPI_COMM_WORLD_RANK", "0")]),
            None
        );
        assert_eq!(found(&[]), None);
    }
}
