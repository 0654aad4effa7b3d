//! Registry references inside settings, and how kinds and entries are linked in.
//!
//! `masking: uniform` and `masking: {use: dirichlet, alpha: 0.001}` both become an [`Entry<T>`]: the entry's name and its
//! settings with the changes applied. `T` says of which kind it is by [`Kind`].

use super::settings::Settings;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{DeserializeOwned, Error as _};
use serde::ser::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;
use std::borrow::Cow;

/// Settings that registry entries of one kind hold: `masking`, `size`, `tokenizer`, ...
pub trait Kind: Serialize + DeserializeOwned + JsonSchema + Send + Sync + 'static {
    /// The first key of the entry's file, and its folder in `registry/`.
    const KIND: &'static str;
    /// One line for `reviv list`.
    const ABOUT: &'static str;
}

/// A registry entry, resolved.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry<T> {
    /// The entry's name.
    pub name: String,
    /// Its settings with the changes of the experiment applied.
    pub settings: T,
}

impl<T: Serialize> Serialize for Entry<T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serde_json::Map::new();
        map.insert("use".to_owned(), Value::String(self.name.clone()));
        match serde_json::to_value(&self.settings).map_err(S::Error::custom)? {
            Value::Object(settings) => map.extend(settings),
            Value::Null => {}
            _ => {
                return Err(S::Error::custom(
                    "settings of a registry entry must be a map",
                ));
            }
        }
        map.serialize(serializer)
    }
}

impl<'de, T: DeserializeOwned> Deserialize<'de> for Entry<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut map = serde_json::Map::deserialize(deserializer)?;
        let Some(Value::String(name)) = map.remove("use") else {
            return Err(D::Error::missing_field("use"));
        };
        let settings = T::deserialize(Value::Object(map)).map_err(D::Error::custom)?;
        Ok(Self { name, settings })
    }
}

impl<T: Kind> JsonSchema for Entry<T> {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        format!("{}_entry", T::KIND).into()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        let settings = generator.subschema_for::<T>();
        json_schema!({ "x-registry": T::KIND, "x-settings": settings })
    }
}

/// A kind of the registry, linked in: `inventory::submit! { KindEntry::of::<MaskingSettings>() }`.
pub struct KindEntry {
    /// [`Kind::KIND`]: the first key of the entries' files.
    pub kind: &'static str,
    /// [`Kind::ABOUT`]: one line for `reviv list`.
    pub about: &'static str,
    /// The schema of the settings.
    pub schema: fn(&mut SchemaGenerator) -> Schema,
    /// Settings with every default filled in; fails where they do not fit the settings struct.
    pub parse: fn(Value) -> Result<Settings, serde_json::Error>,
}

impl KindEntry {
    /// The kind whose settings are `T`.
    pub const fn of<T: Kind>() -> Self {
        Self {
            kind: T::KIND,
            about: T::ABOUT,
            schema: |generator| generator.subschema_for::<T>(),
            parse: Settings::parse::<T>,
        }
    }
}

inventory::collect!(KindEntry);

/// A registry entry that a plug-in crate links in:
/// `inventory::submit! { LinkedEntry { origin: "head_imu 0.1", text: include_str!("head_imu.yaml") } }`.
pub struct LinkedEntry {
    /// Who brings it, for diagnostics.
    pub origin: &'static str,
    /// The entry's file.
    pub text: &'static str,
}

inventory::collect!(LinkedEntry);
