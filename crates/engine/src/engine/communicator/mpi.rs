//! Ranks that are processes, over the system's MPI.
//!
//! One thread talks to MPI; the others hand it what is to be sent. So a rank is heard every second whatever it computes, a wait
//! is never longer than the patience with the others, and the next bucket of a gradient is packed while this one travels.

use super::watch::{Beat, Watch};
use super::{Link, Pending, RankError};
use mpi::Threading;
use mpi::collective::CommunicatorCollectives as _;
use mpi::datatype::PartitionMut;
use mpi::point_to_point::{Destination as _, MatchedReceiveVec as _, Source as _};
use mpi::request::{Request, Scope};
use mpi::topology::{Communicator as _, SimpleCommunicator};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, PoisonError};
use std::time::Duration;

/// Of messages that say a rank is there.
const BEAT: i32 = 7;

/// Seconds between them.
const PERIOD: f64 = 1.0;

/// Seconds that rank 0 has to write its record before the job of a lost rank is ended.
const GRACE: f64 = 4.0;

type Answer<T> = Sender<Result<T, RankError>>;

enum Order {
    Gather(Vec<u8>, Answer<Vec<Vec<u8>>>),
    Exchange(Vec<f32>, Answer<Vec<f32>>),
    Collect(Vec<f32>, Answer<Vec<f32>>),
    Meet,
    Finish(Answer<()>),
    Abort(i32),
}

impl Order {
    fn refuse(self, error: &RankError) {
        // Who does not wait any more need not be told.
        let error = error.clone();
        let _ = match self {
            Self::Gather(_, answer) => answer.send(Err(error)).is_ok(),
            Self::Exchange(_, answer) | Self::Collect(_, answer) => answer.send(Err(error)).is_ok(),
            Self::Finish(answer) => answer.send(Err(error)).is_ok(),
            Self::Meet | Self::Abort(_) => true,
        };
    }
}

/// One process.
pub(super) struct Mpi {
    rank: usize,
    size: usize,
    local_rank: usize,
    stepping: Arc<AtomicBool>,
    orders: Mutex<Sender<Order>>,
}

impl Mpi {
    pub(super) fn start(
        local_rank: usize,
        patience: f64,
        tell: fn(&RankError),
    ) -> Result<Self, String> {
        let (orders, received) = channel();
        let (ready, started) = channel();
        let stepping = Arc::new(AtomicBool::new(false));
        let shared = Arc::clone(&stepping);
        let work = move || {
            let Some((universe, _)) = mpi::initialize_with_threading(Threading::Funneled) else {
                // The receiver says that nothing came.
                return;
            };
            let mut thread = Thread::new(received, shared, patience, tell);
            let _ = ready.send((thread.rank, thread.size));
            if let Some(answer) = thread.work() {
                drop(universe);
                let _ = answer.send(Ok(()));
            }
        };
        let spawned = std::thread::Builder::new().name("mpi".into()).spawn(work);
        spawned.map_err(|error| error.to_string())?;
        let started = started.recv();
        let (rank, size) = started.map_err(|_| "it was started before".to_owned())?;
        Ok(Self {
            rank,
            size,
            local_rank,
            stepping,
            orders: Mutex::new(orders),
        })
    }

    fn order<T>(&self, order: impl FnOnce(Answer<T>) -> Order) -> Pending<T> {
        let (answer, pending) = channel();
        let orders = self.orders.lock().unwrap_or_else(PoisonError::into_inner);
        // The answer's other end goes with an order that nobody takes, and the wait ends with that.
        let _ = orders.send(order(answer));
        Pending::Later(pending)
    }
}

impl Link for Mpi {
    fn rank(&self) -> usize {
        self.rank
    }

    fn size(&self) -> usize {
        self.size
    }

    fn local_rank(&self) -> usize {
        self.local_rank
    }

    fn gather(&self, bytes: Vec<u8>) -> Pending<Vec<Vec<u8>>> {
        self.order(|answer| Order::Gather(bytes, answer))
    }

    fn exchange(&self, values: Vec<f32>) -> Pending<Vec<f32>> {
        self.order(|answer| Order::Exchange(values, answer))
    }

    fn collect(&self, values: Vec<f32>) -> Pending<Vec<f32>> {
        self.order(|answer| Order::Collect(values, answer))
    }

    fn meet(&self) {
        let orders = self.orders.lock().unwrap_or_else(PoisonError::into_inner);
        // Where the thread has ended, the next wait says so.
        let _ = orders.send(Order::Meet);
    }

    fn stepping(&self, yes: bool) {
        self.stepping.store(yes, Ordering::Relaxed);
    }

    fn finish(&self) -> Result<(), RankError> {
        self.order(Order::Finish).wait()
    }

    fn abort(&self, code: i32) {
        let _ = self.order::<()>(|_| Order::Abort(code)).wait();
        // MPI ends the process; until it does, nothing else may happen in it.
        std::thread::sleep(Duration::from_secs(20));
        std::process::exit(code);
    }
}

/// The thread that talks to MPI.
struct Thread {
    rank: usize,
    size: usize,
    hosts: Vec<String>,
    orders: Receiver<Order>,
    stepping: Arc<AtomicBool>,
    tell: fn(&RankError),
    watch: Watch,
    met: u64,
    beaten: f64,
}

impl Thread {
    fn new(
        orders: Receiver<Order>,
        stepping: Arc<AtomicBool>,
        patience: f64,
        tell: fn(&RankError),
    ) -> Self {
        let world = SimpleCommunicator::world();
        let (rank, size) = (world.rank() as usize, world.size() as usize);
        // Where rank 0 is lost, the next one says so before the others do.
        let patience = patience + 5.0 * rank.min(50) as f64;
        let now = mpi::time();
        let mut thread = Self {
            watch: Watch::new(size, patience, now),
            rank,
            size,
            hosts: vec![String::new(); size],
            orders,
            stepping,
            tell,
            met: 0,
            beaten: now,
        };
        let host = mpi::environment::processor_name().unwrap_or_default();
        let (answer, hosts) = channel();
        thread.gather(host.into_bytes(), answer);
        if let Ok(Ok(hosts)) = hosts.recv() {
            let text = |bytes: Vec<u8>| String::from_utf8_lossy(&bytes).into_owned();
            thread.hosts = hosts.into_iter().map(text).collect();
        }
        thread
    }

    /// Serves until all ranks leave; gives whom to tell.
    fn work(&mut self) -> Option<Answer<()>> {
        loop {
            match self.orders.recv_timeout(Duration::from_millis(100)) {
                Ok(Order::Gather(bytes, answer)) => self.gather(bytes, answer),
                Ok(Order::Exchange(values, answer)) => self.exchange(&values, &answer),
                Ok(Order::Collect(values, answer)) => self.collect(&values, &answer),
                Ok(Order::Meet) => self.met += 1,
                Ok(Order::Abort(code)) => SimpleCommunicator::world().abort(code),
                Ok(Order::Finish(answer)) => {
                    let barrier = SimpleCommunicator::world().immediate_barrier();
                    self.wait(barrier, &|_| ());
                    self.listen(mpi::time());
                    return Some(answer);
                }
                Err(RecvTimeoutError::Timeout) => {
                    self.look(&|_| ());
                }
                Err(RecvTimeoutError::Disconnected) => return None,
            }
        }
    }

    fn gather(&mut self, bytes: Vec<u8>, answer: Answer<Vec<Vec<u8>>>) {
        self.met += 1;
        let world = SimpleCommunicator::world();
        let refuse = |error: &RankError| drop(answer.send(Err(error.clone())));
        let mut lengths = vec![0_i32; self.size];
        let length = bytes.len() as i32;
        mpi::request::scope(|scope| {
            let request = world.immediate_all_gather_into(scope, &length, &mut lengths[..]);
            self.wait(request, &refuse);
        });
        let starts: Vec<i32> = lengths
            .iter()
            .scan(0, |at, length| {
                let start = *at;
                *at += length;
                Some(start)
            })
            .collect();
        let mut all = vec![0_u8; lengths.iter().map(|length| *length as usize).sum()];
        let mut parts = PartitionMut::new(&mut all[..], &lengths[..], &starts[..]);
        mpi::request::scope(|scope| {
            let request = world.immediate_all_gather_varcount_into(scope, &bytes[..], &mut parts);
            self.wait(request, &refuse);
        });
        let parts = starts.iter().zip(&lengths);
        let part = |(start, length): (&i32, &i32)| {
            let start = *start as usize;
            all[start..start + *length as usize].to_vec()
        };
        let _ = answer.send(Ok(parts.map(part).collect()));
    }

    fn exchange(&mut self, values: &[f32], answer: &Answer<Vec<f32>>) {
        self.met += 1;
        let refuse = |error: &RankError| drop(answer.send(Err(error.clone())));
        let mut received = vec![0.0_f32; values.len()];
        mpi::request::scope(|scope| {
            let world = SimpleCommunicator::world();
            let request = world.immediate_all_to_all_into(scope, values, &mut received[..]);
            self.wait(request, &refuse);
        });
        let _ = answer.send(Ok(received));
    }

    fn collect(&mut self, values: &[f32], answer: &Answer<Vec<f32>>) {
        self.met += 1;
        let refuse = |error: &RankError| drop(answer.send(Err(error.clone())));
        let mut received = vec![0.0_f32; values.len() * self.size];
        mpi::request::scope(|scope| {
            let world = SimpleCommunicator::world();
            let request = world.immediate_all_gather_into(scope, values, &mut received[..]);
            self.wait(request, &refuse);
        });
        let _ = answer.send(Ok(received));
    }

    /// Waits for MPI, without taking the processor from those who compute, and while all ranks are well.
    fn wait<'a, D: ?Sized, S: Scope<'a>>(
        &mut self,
        mut request: Request<'a, D, S>,
        refuse: &dyn Fn(&RankError),
    ) {
        let mut tries = 0_u32;
        loop {
            match request.test() {
                Ok(_) => return,
                Err(unfinished) => request = unfinished,
            }
            tries += 1;
            match tries {
                0..20 => std::thread::yield_now(),
                20..200 => std::thread::sleep(Duration::from_micros(50)),
                _ => std::thread::sleep(Duration::from_micros(500)),
            }
            if tries.is_multiple_of(8) {
                self.look(refuse);
            }
        }
    }

    /// Says that this rank is there, hears the others, and ends the job where one is lost.
    fn look(&mut self, refuse: &dyn Fn(&RankError)) {
        let now = mpi::time();
        if now - self.beaten < PERIOD {
            return;
        }
        self.beaten = now;
        let beat = Beat {
            met: self.met,
            stepping: self.stepping.load(Ordering::Relaxed),
        };
        self.watch.hear(self.rank, beat, now);
        let world = SimpleCommunicator::world();
        let others = if self.rank == 0 { 1..self.size } else { 0..1 };
        for other in others.clone() {
            let message = [beat.met, u64::from(beat.stepping)];
            // Two words are taken by the library at once, whether or not the other side listens.
            world
                .process_at_rank(other as i32)
                .send_with_tag(&message[..], BEAT);
        }
        self.listen(now);
        // Rank 0 looks at itself too: its computation may hang while this thread does not.
        let watched = if self.rank == 0 { 0..self.size } else { others };
        if let Some(mut error) = self.watch.lost(watched, now) {
            error.host.clone_from(&self.hosts[error.rank]);
            self.end(&error, refuse);
        }
    }

    fn listen(&mut self, now: f64) {
        let world = SimpleCommunicator::world();
        while let Some(message) = world.any_process().immediate_matched_probe_with_tag(BEAT) {
            let (words, status): (Vec<u64>, _) = message.matched_receive_vec();
            if let [met, stepping] = words[..] {
                let beat = Beat {
                    met,
                    stepping: stepping != 0,
                };
                self.watch.hear(status.source_rank() as usize, beat, now);
            }
        }
    }

    /// Ends the job. What MPI was asked for may never come, so that this thread has nothing else to do; rank 0 writes its record
    /// first, if its computation comes to a point where it can.
    fn end(&mut self, error: &RankError, refuse: &dyn Fn(&RankError)) -> ! {
        refuse(error);
        let start = mpi::time();
        while self.rank == 0 && mpi::time() - start < GRACE {
            match self.orders.recv_timeout(Duration::from_millis(50)) {
                Ok(Order::Abort(code)) => SimpleCommunicator::world().abort(code),
                Ok(order) => order.refuse(error),
                Err(_) => {}
            }
        }
        (self.tell)(error);
        SimpleCommunicator::world().abort(2)
    }
}
