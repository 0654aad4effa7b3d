//! What a clip holds of one modality: [`Value`], implemented by the built-in tracks and by whatever a plug-in brings.
//!
//! A value says how it becomes [`Arrays`] and how it comes back; shards and prediction folders need nothing else of it. [`Held`]
//! is a value whose type is not known, [`Key`] a name and the type that stands under it.

use crate::formats::FormatError;
use crate::formats::npy::{Element, NpyArray};
use crate::formats::npz::Npz;
use ndarray::{Array, Array1, ArrayD, Dimension};
use std::any::Any;
use std::fmt::Debug;
use std::marker::PhantomData;

/// What a clip holds of one modality, with its units, validity and frame of reference in the type.
pub trait Value: Debug + Clone + PartialEq + Send + Sync + 'static {
    /// The name of [`Arrays::values`] in a shard.
    const VALUES: &'static str = "values";

    /// As arrays, without loss.
    fn to_arrays(&self) -> Arrays;

    /// The inverse of [`Value::to_arrays`]. The arrays come from a file: nothing about them is certain.
    ///
    /// # Errors
    /// When they are not such a value; the message names the array.
    fn from_arrays(arrays: &Arrays) -> Result<Self, String>;
}

/// A value as arrays: what shards store and prediction folders hold.
#[derive(Debug, Clone)]
pub struct Arrays {
    /// What messages call the values; their validity is `<name>_valid`.
    pub name: String,
    /// The main array: frames, poses, joints or channels. A shard stores it as [`Value::VALUES`].
    pub values: NpyArray,
    /// Which values are known: the shape of the values without their last axes. `None` means all.
    pub valid: Option<NpyArray>,
    /// Hz, for values that say it.
    pub rate: Option<f64>,
    /// Whatever else the value has. Kept in shards, not in predictions.
    pub more: Npz,
    /// Made by another program: what it leaves out is filled in where that is certain.
    pub foreign: bool,
}

impl Arrays {
    /// Values without validity or rate.
    pub fn new(values: impl Into<NpyArray>) -> Self {
        Self {
            name: String::new(),
            values: values.into(),
            valid: None,
            rate: None,
            more: Npz::default(),
            foreign: false,
        }
    }

    /// With the validity of the values.
    #[must_use]
    pub fn valid(mut self, valid: impl Into<NpyArray>) -> Self {
        self.valid = Some(valid.into());
        self
    }

    /// With a rate in Hz.
    #[must_use]
    pub fn rate(mut self, rate: f64) -> Self {
        self.rate = Some(rate);
        self
    }

    /// With another array.
    #[must_use]
    pub fn with(mut self, name: &str, array: impl Into<NpyArray>) -> Self {
        self.more = self.more.with(name, array);
        self
    }

    /// The values as an array of this type and number of axes.
    ///
    /// # Errors
    /// When they are of another kind.
    pub fn read<T: Element, D: Dimension>(&self) -> Result<Array<T, D>, String> {
        let array = self.values.to_dim();
        array.map_err(|error| format!("array `{}`: {error}", self.name))
    }

    /// The validity, in this shape; one number per sample stands for all values of the sample, none for all valid.
    ///
    /// # Errors
    /// When it has another shape.
    pub fn read_valid<D: Dimension>(&self, shape: &[usize]) -> Result<Array<bool, D>, String> {
        let refuse = |reason: String| format!("array `{}_valid`: {reason}", self.name);
        let Some(array) = &self.valid else {
            let all = ArrayD::from_elem(shape.to_vec(), true);
            return all.into_dimensionality().map_err(|e| refuse(e.to_string()));
        };
        let found = array
            .to::<bool>()
            .map_err(|error| refuse(error.to_string()))?;
        let per_sample = found.ndim() == 1 && shape.first() == found.shape().first();
        let found = if per_sample {
            ArrayD::from_shape_fn(shape.to_vec(), |at| found[[at[0]]])
        } else {
            found
        };
        expect_shape(&format!("{}_valid", self.name), found.shape(), shape)?;
        found
            .into_dimensionality()
            .map_err(|error| refuse(error.to_string()))
    }

    /// The rate.
    ///
    /// # Errors
    /// When there is none.
    pub fn read_rate(&self) -> Result<f64, String> {
        self.rate.ok_or_else(|| "no array `rate`".to_owned())
    }

    /// As the member of a shard, the values under this name.
    fn into_npz(self, values: &str) -> Npz {
        let mut npz = self.more.with(values, self.values);
        if let Some(valid) = self.valid {
            npz = npz.with("valid", valid);
        }
        match self.rate {
            Some(rate) => npz.with("rate", Array1::from_elem(1, rate)),
            None => npz,
        }
    }
}

/// Refuses a shape that is not the expected one, naming the array.
///
/// # Errors
/// When the shapes differ.
pub fn expect_shape(name: &str, found: &[usize], expected: &[usize]) -> Result<(), String> {
    if found == expected {
        return Ok(());
    }
    Err(format!(
        "array `{name}`: {found:?} where {expected:?} is needed"
    ))
}

/// A value of whatever type.
#[derive(Debug)]
pub struct Held(Box<dyn AnyValue>);

trait AnyValue: Any + Debug + Send + Sync {
    fn copy(&self) -> Box<dyn AnyValue>;
    fn equals(&self, other: &dyn Any) -> bool;
    fn arrays(&self) -> Arrays;
    fn values(&self) -> &'static str;
}

impl<T: Value> AnyValue for T {
    fn copy(&self) -> Box<dyn AnyValue> {
        Box::new(self.clone())
    }
    fn equals(&self, other: &dyn Any) -> bool {
        other.downcast_ref() == Some(self)
    }
    fn arrays(&self) -> Arrays {
        self.to_arrays()
    }
    fn values(&self) -> &'static str {
        T::VALUES
    }
}

impl Held {
    /// Forgets the type.
    pub fn new<T: Value>(value: T) -> Self {
        Self(Box::new(value))
    }

    /// The value, if it is a `T`.
    #[must_use]
    pub fn get<T: Value>(&self) -> Option<&T> {
        let any: &dyn Any = &*self.0;
        any.downcast_ref()
    }

    pub(super) fn get_mut<T: Value>(&mut self) -> Option<&mut T> {
        let any: &mut dyn Any = &mut *self.0;
        any.downcast_mut()
    }

    pub(super) fn take<T: Value>(self) -> Option<T> {
        let any: Box<dyn Any> = self.0;
        any.downcast().ok().map(|value| *value)
    }

    /// As arrays.
    #[must_use]
    pub fn to_arrays(&self) -> Arrays {
        self.0.arrays()
    }

    /// As the member of a shard.
    #[must_use]
    pub fn to_npz(&self) -> Npz {
        self.0.arrays().into_npz(self.0.values())
    }
}

impl Clone for Held {
    fn clone(&self) -> Self {
        Self(self.0.copy())
    }
}

impl PartialEq for Held {
    fn eq(&self, other: &Self) -> bool {
        self.0.equals(&*other.0)
    }
}

/// A modality's name and the type of what clips hold under it.
#[derive(Debug)]
pub struct Key<'a, T>(pub(super) &'a str, PhantomData<fn() -> T>);

impl<'a, T: Value> Key<'a, T> {
    /// The key of this name.
    #[must_use]
    pub const fn new(name: &'a str) -> Self {
        Self(name, PhantomData)
    }

    /// The modality.
    #[must_use]
    pub const fn name(&self) -> &'a str {
        self.0
    }
}

impl<T> Clone for Key<'_, T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Key<'_, T> {}

/// How values of one type are read: what a modality says of the type its clips hold.
#[derive(Debug, Clone, Copy)]
pub struct Form {
    values: &'static str,
    read: fn(&Arrays) -> Result<Held, String>,
}

impl Form {
    /// Of values of type `T`.
    #[must_use]
    pub const fn of<T: Value>() -> Self {
        Self {
            values: T::VALUES,
            read: read::<T>,
        }
    }

    /// From arrays.
    ///
    /// # Errors
    /// When they are no such value.
    pub fn read(&self, arrays: &Arrays) -> Result<Held, String> {
        (self.read)(arrays)
    }

    /// From the member of a shard.
    ///
    /// # Errors
    /// When an array is missing or not what it should be.
    pub fn read_npz(&self, mut npz: Npz) -> Result<Held, String> {
        let words = |error: FormatError| error.to_string();
        let rate = npz.arrays.get("rate").map(NpyArray::to::<f64>).transpose();
        let rate = match rate.map_err(words)?.as_ref().map(|rate| rate.first()) {
            None => None,
            Some(Some(rate)) if rate.is_finite() && *rate > 0.0 => Some(*rate),
            Some(_) => return Err("`rate` is not a positive number".to_owned()),
        };
        npz.get(self.values).map_err(words)?;
        let values = npz.arrays.remove(self.values).expect("it was just there");
        self.read(&Arrays {
            name: self.values.to_owned(),
            values,
            valid: npz.arrays.remove("valid"),
            rate,
            more: npz,
            foreign: false,
        })
    }
}

fn read<T: Value>(arrays: &Arrays) -> Result<Held, String> {
    T::from_arrays(arrays).map(Held::new)
}
