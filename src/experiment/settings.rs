//! The settings of a stage: parsed once, typed for its op, and as the JSON that names its artifact.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;
use std::any::Any;
use std::fmt;
use std::sync::Arc;

/// Settings with every default filled in. A copy shares them. In a file they are their JSON; what is read back from one is not
/// typed before an op uses it.
#[derive(Clone)]
pub struct Settings {
    json: Arc<Value>,
    typed: Option<Arc<dyn Any + Send + Sync>>,
}

impl Settings {
    /// Parses settings of the type `T`.
    ///
    /// # Errors
    /// When they do not fit.
    pub fn parse<T>(settings: Value) -> Result<Self, serde_json::Error>
    where
        T: Serialize + DeserializeOwned + Send + Sync + 'static,
    {
        let typed: T = serde_json::from_value(settings)?;
        Ok(Self {
            json: Arc::new(serde_json::to_value(&typed)?),
            typed: Some(Arc::new(typed)),
        })
    }

    /// As JSON: what keys, records and `resolved.yaml` hold.
    pub fn json(&self) -> &Value {
        &self.json
    }

    /// As the struct that they were parsed into; `None` for another type, and where they come from a file.
    pub fn typed<T: 'static>(&self) -> Option<&T> {
        self.typed.as_deref()?.downcast_ref()
    }

    /// Does something with the struct; settings from a file are parsed for it.
    ///
    /// # Errors
    /// When settings from a file, or those of another op, do not fit.
    pub fn with<T: DeserializeOwned + 'static, R>(
        &self,
        act: impl FnOnce(&T) -> R,
    ) -> Result<R, serde_json::Error> {
        match self.typed() {
            Some(typed) => Ok(act(typed)),
            None => T::deserialize(self.json()).map(|typed| act(&typed)),
        }
    }
}

impl From<Value> for Settings {
    fn from(json: Value) -> Self {
        Self {
            json: Arc::new(json),
            typed: None,
        }
    }
}

impl Serialize for Settings {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.json.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Settings {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Value::deserialize(deserializer).map(Self::from)
    }
}

impl fmt::Debug for Settings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.json.fmt(f)
    }
}

impl PartialEq for Settings {
    fn eq(&self, other: &Self) -> bool {
        self.json == other.json
    }
}
