// Evaluates $COUNT splats of a batch, from `s` to before $END, at the PER_THREAD pixels of a thread. For splat m from
// `s` on it defines `center$m`, `squares$m`, `column$m`, `threshold$m_$l`, and, if $COUNT > 1, for pixel j `y$m_$j` and
// `raw$m_$j`, its alpha before the cap, 0 if there is no such splat. All are evaluated at once and without branches, so
// that the latency of one is hidden behind the others.
//#for m in 0..$COUNT
//#if $m<1
let at$m = s;
//#else
let at$m = min(s + $mu, $END - 1u);
//#end
let center$m = batch_center[at$m];
let squares$m = batch_squares[at$m].xyz;
let column$m = gaussian_column(center$m.xy, squares$m, px);
//#for l in 0..LAYERS
let threshold$m_$l = batch_threshold[at$m * LAYERS + $lu];
//#end
//#if 1<$COUNT
//#for j in 0..PER_THREAD
let y$m_$j = py$j - column$m.row;
let raw$m_$j = select(0.0, alpha_at(column$m, center$m.w, y$m_$j), s + $mu < $END);
//#end
//#end
//#end
