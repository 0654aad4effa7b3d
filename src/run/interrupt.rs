//! Ctrl-C: the first asks to stop at the next point that can be resumed, the second stops at once.

use super::error::RunError;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A flag that long work polls. Clones share it.
#[derive(Debug, Clone, Default)]
pub struct Interrupt(Arc<AtomicBool>);

impl Interrupt {
    /// Asks everything that polls this flag to stop.
    pub fn request(&self) {
        self.0.store(true, Ordering::SeqCst);
    }

    /// Whether somebody has asked to stop.
    pub fn requested(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// `Err(Interrupted)` once a stop was asked for: `interrupt.check()?` between two steps.
    pub fn check(&self) -> Result<(), RunError> {
        if self.requested() {
            Err(RunError::Interrupted)
        } else {
            Ok(())
        }
    }

    /// Sets the flag on Ctrl-C, SIGTERM and SIGHUP, and calls `told` so that the user sees it was heard; a second one ends
    /// the process with 130. Call once per process.
    pub fn on_signals(&self, told: impl Fn() + Send + 'static) -> Result<(), RunError> {
        let flag = self.clone();
        let handler = move || {
            if flag.0.swap(true, Ordering::SeqCst) {
                std::process::exit(130);
            }
            told();
        };
        ctrlc::set_handler(handler).map_err(|error| RunError::Request {
            message: format!("Ctrl-C cannot be caught: {error}"),
            help: "only one handler may be set in a process".into(),
        })
    }
}
