//! Decoders that stand in the middle of a file, so that whoever reads on need not start again at the key frame before.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

/// Decoders of one file, the one that was parked first in front.
pub(super) struct Parked<T>(Mutex<Vec<T>>);

impl<T> Default for Parked<T> {
    fn default() -> Self {
        Parked(Mutex::default())
    }
}

impl<T> std::fmt::Debug for Parked<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Parked").finish_non_exhaustive()
    }
}

/// Something that holds parked decoders.
trait Evict: Send + Sync {
    fn evict(&self);
}

/// Whose decoders are parked, in the order in which that happened: a decoder holds pictures or a process, and all files together
/// keep no more of them than there are threads to read on.
static ORDER: Mutex<VecDeque<Weak<dyn Evict>>> = Mutex::new(VecDeque::new());

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl<T: Send> Evict for Parked<T> {
    fn evict(&self) {
        let mut held = lock(&self.0);
        if !held.is_empty() {
            held.remove(0);
        }
    }
}

impl<T: Send + 'static> Parked<T> {
    /// The decoder of the greatest value, among those that have one.
    pub(super) fn take(self: &Arc<Self>, value: impl Fn(&T) -> Option<usize>) -> Option<T> {
        let mut held = lock(&self.0);
        let fitting = held.iter().enumerate();
        let fitting = fitting.filter_map(|(at, decoder)| Some((value(decoder)?, at)));
        let (_, at) = fitting.max()?;
        let taken = held.remove(at);
        drop(held);
        let mut order = lock(&ORDER);
        let own: Weak<dyn Evict> = Arc::downgrade(self) as Weak<dyn Evict>;
        if let Some(at) = order.iter().position(|other| same(other, &own)) {
            order.remove(at);
        }
        Some(taken)
    }

    /// Keeps a decoder, in place of the one that was parked first where there are too many.
    pub(super) fn park(self: &Arc<Self>, decoder: T) {
        lock(&self.0).push(decoder);
        let most = std::thread::available_parallelism().map_or(2, usize::from);
        let mut order = lock(&ORDER);
        order.retain(|holder| holder.strong_count() > 0);
        order.push_back(Arc::downgrade(self) as Weak<dyn Evict>);
        let surplus = order.len().saturating_sub(most);
        let evicted: Vec<_> = order.drain(..surplus).collect();
        drop(order);
        for holder in evicted.iter().filter_map(Weak::upgrade) {
            holder.evict();
        }
    }
}

/// Whether both are the same file's.
fn same(one: &Weak<dyn Evict>, other: &Weak<dyn Evict>) -> bool {
    std::ptr::addr_eq(one.as_ptr(), other.as_ptr())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_one_is_taken_and_the_oldest_ones_go() {
        let parked: Arc<Parked<usize>> = Arc::default();
        let most = std::thread::available_parallelism().map_or(2, usize::from);
        for position in 0..most + 40 {
            parked.park(position);
        }
        assert!(lock(&parked.0).len() <= most, "{:?}", lock(&parked.0));
        parked.park(1000);
        assert_eq!(parked.take(|at| (*at <= 1000).then_some(*at)), Some(1000));
        assert_eq!(parked.take(|at| (*at > 1000).then_some(*at)), None);
        // Taken and parked in turn, as one reader does, nothing is lost.
        for position in 2000..2200 {
            parked.park(position);
            assert_eq!(
                parked.take(|at| (*at == position).then_some(1)),
                Some(position)
            );
        }
    }
}
