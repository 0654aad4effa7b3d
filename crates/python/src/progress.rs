//! Calls back into Python from compute that runs without its lock.

use pyo3::prelude::*;
use reviv::Flow;

/// Who hears how far it is: `callback(done, total, unit)`, which stops the work by returning `False`. Ctrl-C is looked for too.
#[derive(Debug)]
pub struct Progress {
    callback: Option<Py<PyAny>>,
    failed: Option<PyErr>,
}

impl Progress {
    /// Nobody, or this callable.
    pub fn new(callback: Option<Py<PyAny>>) -> Self {
        Self {
            callback,
            failed: None,
        }
    }

    /// Tells how far it is.
    pub fn tell(&mut self, done: usize, total: usize, unit: &str) -> Flow {
        let told = Python::attach(|py| {
            py.check_signals()?;
            let Some(callback) = &self.callback else {
                return Ok(true);
            };
            let answer = callback.bind(py).call1((done, total, unit))?;
            Ok(answer.is_none() || answer.is_truthy()?)
        });
        match told {
            Ok(true) => Flow::Continue,
            Ok(false) => Flow::Stop,
            Err(error) => {
                self.failed = Some(error);
                Flow::Stop
            }
        }
    }

    /// What the callback raised, if that is why the work stopped.
    pub fn raised(self) -> Option<PyErr> {
        self.failed
    }
}
