//! Time and work of operations by kind, for profiles: [`start`], run something, [`stop`].
//!
//! Off, an operation pays one look at a thread-local flag; on, two looks at the clock. The account belongs to the
//! thread that calls the operations: they return when the last of their tasks is done, so its clock sees
//! all of them. An operation inside another is part of the outer one.

use crate::gemm::{PanelData, Panels};
use std::cell::Cell;
use std::time::{Duration, Instant};

/// Kind of an operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Op {
    /// Matrix products with f32 or f16 weights.
    Gemm,
    /// Matrix products of bytes.
    GemmS8,
    /// Masked attention.
    Attention,
    /// Masked attention of bytes.
    AttentionS8,
    /// Convolutions and transposed convolutions.
    Conv,
    /// The same with int8 weights.
    ConvS8,
    /// Layer norms, query and key norms with the rotary embedding.
    Norm,
    /// Rotation and quantization of rows to bytes.
    Quantize,
    /// Bilinear resizes and pixel shuffles.
    Resize,
    /// Element by element: sums, rectifiers, activations of maps.
    Elementwise,
    /// Copies and checks between operations.
    Glue,
}

impl Op {
    /// Every kind, in the order of an account.
    pub const ALL: [Op; 11] = [
        Op::Gemm,
        Op::GemmS8,
        Op::Attention,
        Op::AttentionS8,
        Op::Conv,
        Op::ConvS8,
        Op::Norm,
        Op::Quantize,
        Op::Resize,
        Op::Elementwise,
        Op::Glue,
    ];

    /// Its name in reports.
    pub fn name(self) -> &'static str {
        match self {
            Op::Gemm => "gemm",
            Op::GemmS8 => "gemm_s8",
            Op::Attention => "attention",
            Op::AttentionS8 => "attention_s8",
            Op::Conv => "conv",
            Op::ConvS8 => "conv_s8",
            Op::Norm => "norm",
            Op::Quantize => "quantize",
            Op::Resize => "resize",
            Op::Elementwise => "elementwise",
            Op::Glue => "glue",
        }
    }
}

/// Work of one operation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Work {
    /// Multiply-adds.
    pub macs: u64,
    /// Bytes of all operands, each once.
    pub bytes: u64,
}

impl Work {
    /// `m` rows through a weight matrix; `inputs` f32 values are read.
    pub(crate) fn product(m: usize, w: &Panels, inputs: usize) -> Work {
        let weight = match w.data {
            PanelData::F32(_) => 4,
            PanelData::F16(_) => 2,
        };
        Work { macs: (m * w.n * w.k) as u64, bytes: (4 * (inputs + m * w.n) + weight * w.n * w.k) as u64 }
    }

    /// No multiply-adds: values of four bytes that are read and written.
    pub fn values(n: usize) -> Work {
        Work { macs: 0, bytes: 8 * n as u64 }
    }
}

/// What the operations of one kind did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Account {
    /// Operations.
    pub calls: u64,
    /// Their work.
    pub work: Work,
    /// Wall time.
    pub time: Duration,
}

/// An account for every kind of [`Op::ALL`].
pub type Accounts = [Account; Op::ALL.len()];

thread_local! {
    static ON: Cell<bool> = const { Cell::new(false) };
    static ACCOUNTS: Cell<Accounts> = const {
        let none = Account { calls: 0, work: Work { macs: 0, bytes: 0 }, time: Duration::ZERO };
        Cell::new([none; Op::ALL.len()])
    };
}

/// Empties this thread's account and starts to fill it.
pub fn start() {
    ACCOUNTS.set(Accounts::default());
    ON.set(true);
}

/// Ends the account.
pub fn stop() -> Accounts {
    ON.set(false);
    ACCOUNTS.get()
}

/// An operation in progress; it ends when this is dropped.
#[derive(Debug)]
#[must_use = "the operation ends when this is dropped"]
pub struct Span(Option<(Op, Work, Instant)>);

/// Books from here to the end of the returned value's scope, when an account is open.
#[inline]
pub fn span(op: Op, work: impl FnOnce() -> Work) -> Span {
    if !ON.get() {
        return Span(None);
    }
    // What runs inside finds the account closed.
    ON.set(false);
    Span(Some((op, work(), Instant::now())))
}

impl Drop for Span {
    fn drop(&mut self) {
        let Some((op, work, start)) = self.0 else { return };
        let time = start.elapsed();
        let mut accounts = ACCOUNTS.get();
        let account = &mut accounts[op as usize];
        account.calls += 1;
        account.work.macs += work.macs;
        account.work.bytes += work.bytes;
        account.time += time;
        ACCOUNTS.set(accounts);
        ON.set(true);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_stand_where_their_number_says() {
        for (i, op) in Op::ALL.into_iter().enumerate() {
            assert_eq!(op as usize, i);
        }
    }

    #[test]
    fn an_account_holds_what_ran_while_it_was_open() {
        let work = || Work { macs: 3, bytes: 5 };
        drop(span(Op::Gemm, work));
        start();
        for _ in 0..2 {
            let _outer = span(Op::Conv, work);
            // Part of the outer one.
            let _inner = span(Op::Gemm, work);
            std::thread::sleep(Duration::from_millis(2));
        }
        drop(span(Op::Norm, || Work::values(4)));
        let accounts = stop();
        drop(span(Op::Conv, work));
        let conv = accounts[Op::Conv as usize];
        assert_eq!((conv.calls, conv.work), (2, Work { macs: 6, bytes: 10 }));
        assert!(conv.time >= Duration::from_millis(4), "{:?}", conv.time);
        assert_eq!(accounts[Op::Gemm as usize], Account::default());
        assert_eq!(accounts[Op::Norm as usize].work, Work { macs: 0, bytes: 32 });
        assert_eq!(stop(), accounts, "nothing is booked after the end");
        start();
        assert_eq!(stop(), Accounts::default(), "a new account starts empty");
    }
}
