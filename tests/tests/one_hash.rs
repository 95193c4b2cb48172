//! The trained network predicts the same bits on every instruction set, for any number of threads, and every time:
//! three generated streets, f16 and int8. `scripts/test-one-hash.sh` does the same at full size and on emulated CPUs.

use sf_formats::Dtype;
use sf_ops::cpu::Isa;
use sf_tests::nano;
use sf_tests::tiny::bits;
use std::sync::Arc;
use streetforward::{Options, Session};

#[test]
fn one_hash() {
    let mut ran = Vec::new();
    for precision in [Dtype::F16, Dtype::Int8] {
        let (model, blob) = nano::converted(precision);
        assert!(nano::converted(precision).1 == blob, "two conversions to {} differ", precision.name());
        for (frames, seed) in [2, 3, 1].into_iter().zip(nano::held_out(100, 3)) {
            let clip = nano::street(seed, frames, (56, 42));
            let mut want = Vec::new();
            for isa in Isa::ALL {
                if sf_ops::Kernels::capped(isa).is_err() {
                    continue;
                }
                // Scalar code takes most of the time; the script runs it on 2 and 3 threads, too.
                let counts: &[usize] = if isa == Isa::Scalar { &[1, 8] } else { &[1, 2, 3, 8] };
                for &threads in counts {
                    let options = Options { threads, isa: Some(isa), ..Options::default() };
                    let mut session = Session::new(Arc::clone(&model), clip.shape, options).unwrap();
                    assert_eq!(session.kernels().isa, isa);
                    for repeat in 0..2 {
                        let have = bits(session.run(&clip.input()).unwrap());
                        if want.is_empty() {
                            want = have;
                            continue;
                        }
                        let at = (precision.name(), seed, isa.name(), threads, repeat);
                        assert!(have == want, "{at:?} differs from one thread of scalar code");
                    }
                }
                ran.push(isa.name());
            }
        }
    }
    ran.sort_unstable();
    ran.dedup();
    let missing: Vec<&str> = Isa::ALL.iter().map(|i| i.name()).filter(|n| !ran.contains(n)).collect();
    println!("ran: {}; not on this CPU: {}", ran.join(" "), missing.join(" "));
    assert!(ran.contains(&"scalar"));
}
