"""Optimiser on two flat buffers: Muon for the transformer's matrices, AdamW for everything else, EMA of all."""

import math

import torch

MUON = (".attn.qkv.weight", ".attn.proj.weight", ".mlp.fc1.weight", ".mlp.fc2.weight")

# Output layers whose numbers are metres or log ratios: the factor on their step that an output scale would give.
STEP_FACTOR = {"camera_head.fc_t.": 5.0, "camera_head.fc_fov.": 0.3}

# Its gradient is cut by itself: calibrated units have large weights, and its norm (130 against 2 of all others) would decide
# how much a batch counts for the trunk.
APART = "camera_head."


def orthogonal(g, steps=5):
    """Newton-Schulz iteration towards the nearest matrix with singular values near one; g [N, a, b], a <= b."""
    a, b, c = 3.4445, -4.7750, 2.0315
    x = g / (g.norm(dim=(-2, -1), keepdim=True) + 1e-7)
    for _ in range(steps):
        y = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(y, y, y, beta=b, alpha=c), x, beta=a)  # a x + (b y + c y y) x, a sixth faster
    return x


class Optimizer:
    """Parameters, gradients, moments and EMA are one vector each; the model's tensors are views into them.

    One vector makes the exchange between ranks, clipping, EMA and saving single operations. `trainable(name)` chooses.
    """

    def __init__(self, model, trainable, *, lr=1e-3, muon_lr=2e-3, decay=0.01, muon_decay=0.05, clip=2.0, ema=0.999):
        named = [(name, p) for name, p in model.named_parameters() if trainable(name)]
        for p in model.parameters():
            p.requires_grad_(False)
        matrices = sorted((n, p) for n, p in named if n.endswith(MUON))
        matrices.sort(key=lambda pair: tuple(pair[1].shape))
        others = [(n, p) for n, p in named if not n.endswith(MUON)]
        self.names = [n for n, _ in matrices + others]
        total = sum(p.numel() for _, p in named)
        device = named[0][1].device
        zeros = lambda n: torch.zeros(n, device=device)  # noqa: E731
        self.weights, self.grads, self.average = zeros(total), zeros(total), zeros(total)
        self.edge = sum(p.numel() for _, p in matrices)  # Muon's parameters come first
        self.momentum = zeros(self.edge)
        self.first, self.second = zeros(total - self.edge), zeros(total - self.edge)
        self.factor, self.decays = zeros(total - self.edge) + 1, zeros(total - self.edge)
        self.groups, at = [], 0  # runs of matrices of one shape: (offset, count, shape)
        self.parts = [[], []]  # [from, to) of the parameters that are cut together: the trunk's, and those under APART
        for name, p in matrices + others:
            n, shape = p.numel(), p.shape
            self.weights[at : at + n] = p.detach().flatten()
            p.data = self.weights[at : at + n].view(shape)
            p.grad = self.grads[at : at + n].view(shape)
            p.requires_grad_(True)
            spans = self.parts[name.startswith(APART)]
            if spans and spans[-1][1] == at:
                spans[-1][1] += n
            else:
                spans.append([at, at + n])
            if at < self.edge:
                if self.groups and self.groups[-1][2] == shape:
                    self.groups[-1][1] += 1
                else:
                    self.groups.append([at, 1, shape])
            else:
                here = slice(at - self.edge, at - self.edge + n)
                for prefix, factor in STEP_FACTOR.items():
                    if name.startswith(prefix):
                        self.factor[here] = factor
                if p.ndim > 1 and "token" not in name and "pos_embed" not in name:
                    self.decays[here] = decay
            at += n
        self.average.copy_(self.weights)
        self.lr, self.muon_lr, self.muon_decay, self.clip, self.ema = lr, muon_lr, muon_decay, clip, ema
        self.steps = 0

    @torch.no_grad()
    def step(self, scale, rank=0, ranks=1, reduce=None):
        """One update at `scale` times the learning rates; returns the gradient's norm without the camera head's.

        With ranks the gradients are averaged first, and each rank orthogonalises its share of the matrices.
        """
        if ranks > 1:
            reduce(self.grads)
            self.grads /= ranks
        norms = [math.hypot(*(self.grads[a:b].norm().item() for a, b in spans)) for spans in self.parts]
        norm = norms[0]
        if not math.isfinite(sum(norms)):
            self.grads.zero_()
            return sum(norms)
        for n, spans in zip(norms, self.parts):
            if n > self.clip:
                for a, b in spans:
                    self.grads[a:b].mul_(self.clip / n)
        self.steps += 1

        self.momentum.mul_(0.95).add_(self.grads[: self.edge])
        mixed = self.grads[: self.edge] + 0.95 * self.momentum
        update = torch.zeros_like(mixed)
        for at, count, (rows, columns) in self.groups:
            lo, hi = count * rank // ranks, count * (rank + 1) // ranks
            if lo == hi:
                continue
            part = slice(at + lo * rows * columns, at + hi * rows * columns)
            g = mixed[part].view(hi - lo, rows, columns)
            o = orthogonal(g) if rows <= columns else orthogonal(g.mT).mT
            # 0.2 sqrt(longer side) gives the update the size of AdamW's.
            update[part] = 0.2 * max(rows, columns) ** 0.5 * o.flatten()
        if ranks > 1:
            reduce(update)
        w = self.weights[: self.edge]
        w.mul_(1 - scale * self.muon_lr * self.muon_decay).add_(update, alpha=-scale * self.muon_lr)

        g, w = self.grads[self.edge :], self.weights[self.edge :]
        self.first.lerp_(g, 0.1)
        self.second.mul_(0.98).addcmul_(g, g, value=0.02)
        root = (self.second / (1 - 0.98**self.steps)).sqrt_().add_(1e-8)
        direction = self.first / (1 - 0.9**self.steps) / root
        w.sub_(scale * self.lr * self.factor * (direction + self.decays * w))

        self.average.lerp_(self.weights, 1 - min(self.ema, (1 + self.steps) / (10 + self.steps)))
        self.grads.zero_()
        return norm

    def swap(self):
        """Exchanges the weights and their average: evaluation uses the average and swaps back."""
        kept = self.weights.clone()
        self.weights.copy_(self.average)
        self.average.copy_(kept)

    STATE = ("weights", "average", "momentum", "first", "second")

    def state(self):
        return {key: getattr(self, key).cpu().clone() for key in self.STATE} | {"steps": self.steps, "names": self.names}

    def load(self, state):
        if state["names"] != self.names:
            raise ValueError("the saved optimiser trains other tensors than this run")
        for key in self.STATE:
            getattr(self, key).copy_(state[key])
        self.steps = state["steps"]
