//! Objects behind numbers.
//!
//! A handle is `kind (8 bits) | generation (24) | place (32)`: one that was never given out, was destroyed, is of another kind or was made
//! before a fork is recognised, also when its place is taken again. An object is used by one call at a time.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};

use sf_formats::{Error, Result};

/// Most objects of a kind at a time.
const MAX_OBJECTS: usize = 1 << 16;

/// All objects of a kind.
pub(crate) struct Table<T> {
    kind: u8,
    /// For messages.
    name: &'static str,
    slots: Mutex<Vec<Slot<T>>>,
}

struct Slot<T> {
    generation: u32,
    /// The object and the process that made it: threads do not survive a fork.
    object: Option<(Arc<Mutex<T>>, u32)>,
}

impl<T> Table<T> {
    pub(crate) const fn new(kind: u8, name: &'static str) -> Table<T> {
        Table { kind, name, slots: Mutex::new(Vec::new()) }
    }

    fn slots(&self) -> MutexGuard<'_, Vec<Slot<T>>> {
        // Nothing that is done under the lock leaves a slot half changed.
        self.slots.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes an object and gives its handle.
    pub(crate) fn insert(&self, object: T) -> Result<u64> {
        let object = Some((Arc::new(Mutex::new(object)), std::process::id()));
        let mut slots = self.slots();
        let place = match slots.iter().position(|s| s.object.is_none()) {
            Some(place) => place,
            None if slots.len() < MAX_OBJECTS => {
                slots.push(Slot { generation: 0, object: None });
                slots.len() - 1
            }
            None => return Err(Error::resource(self.name, format!("{MAX_OBJECTS} exist already: destroy some"))),
        };
        let slot = &mut slots[place];
        slot.generation = (slot.generation + 1) & 0xff_ffff;
        slot.object = object;
        Ok(u64::from(self.kind) << 56 | u64::from(slot.generation) << 32 | place as u64)
    }

    fn slot<'a>(&self, slots: &'a mut [Slot<T>], handle: u64) -> Result<&'a mut Slot<T>> {
        let wrong = |why| Err(Error::usage(format!("{}: handle {handle:#x} {why}", self.name)));
        if (handle >> 56) as u8 != self.kind {
            return wrong("was not made by the function that creates one");
        }
        match slots.get_mut(handle as u32 as usize) {
            Some(s) if s.object.is_some() && u64::from(s.generation) == handle >> 32 & 0xff_ffff => Ok(s),
            _ => wrong("does not exist: it was destroyed or never made"),
        }
    }

    /// Uses an object.
    pub(crate) fn with<R>(&self, handle: u64, body: impl FnOnce(&mut T) -> Result<R>) -> Result<R> {
        let object = {
            let mut slots = self.slots();
            let (object, process) = self.slot(&mut slots, handle)?.object.as_ref().expect("checked by slot");
            if *process != std::process::id() {
                return Err(Error::usage(format!("{}: made before a fork: create one in this process", self.name)));
            }
            Arc::clone(object)
        };
        match object.try_lock() {
            Ok(mut object) => body(&mut object),
            Err(TryLockError::WouldBlock) => {
                Err(Error::usage(format!("{}: in use by another thread: one call at a time", self.name)))
            }
            Err(TryLockError::Poisoned(_)) => {
                Err(Error::Internal(format!("{}: an earlier call failed inside: destroy it", self.name)))
            }
        }
    }

    /// Forgets an object; 0 is nothing to forget. A call that uses it goes on to its end.
    pub(crate) fn remove(&self, handle: u64) -> Result<()> {
        if handle == 0 {
            return Ok(());
        }
        let (object, process) = {
            let mut slots = self.slots();
            self.slot(&mut slots, handle)?.object.take().expect("checked by slot")
        };
        if process != std::process::id() {
            // Its threads are not here to be joined.
            std::mem::forget(object);
        }
        Ok(())
    }
}
