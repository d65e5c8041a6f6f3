"""Prototype: whole-object search."""
import sys, json, time
from dataclasses import fields, replace
from pathlib import Path
import cv2, numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.ndimage import gaussian_filter
sys.path.append("/work/frozen/experiments/tracking")
from run import *
from mstfilter.mst.tracking.residual import MotionResidual, refine_motion, normals
from mstfilter.mst.tracking.rigid import invert, move_points
from mstfilter.mst.tracking.segments import segments_of, Track
from mstfilter.mst.tracking.flow import DenseFlow
from mstfilter.mst.tracking.registration import prepare, SmallGicp
from mstfilter.scene import depth_sigma

def model_of(track, voxels, grid):
    """points (N,3), normals (N,3), colours (N,3) NaN where unknown."""
    pix = track.sampled(400)
    p = track.clip.before.points.reshape(-1,3)[pix].astype(float)
    n = normals(track.clip.before).reshape(-1,3)[pix].astype(float)
    c = track.sample(400)[1]
    ok = np.isfinite(n).all(axis=1)
    p, n, c = p[ok], n[ok], c[ok]
    occ = np.zeros(grid.shape, np.float32); occ.ravel()[voxels] = 1
    idx = np.argwhere(occ > 0); lo = idx.min(0)-3; hi = idx.max(0)+4
    lo2 = np.maximum(lo,0); hi2=np.minimum(hi,grid.shape)
    box = np.zeros(hi-lo, np.float32)
    box[tuple(idx.T - lo[:,None])] = 1
    smooth = gaussian_filter(box, 1.0)
    g = np.stack(np.gradient(smooth), -1)
    pad = np.pad(box,1)
    core = np.ones_like(box,bool)
    for ax in range(3):
        for s in (-1,1):
            core &= np.roll(pad,s,ax)[1:-1,1:-1,1:-1]>0
    surf = np.argwhere((box>0)&~core)
    nn = -g[tuple(surf.T)]; nn /= np.linalg.norm(nn,axis=1,keepdims=True)+1e-9
    q = grid.centre_of(surf+lo) + 0.3*grid.voxel_size*nn
    if len(p):
        far = cKDTree(p).query(q)[0] > 0.012
        q, nn = q[far], nn[far]
    if len(q) > 600:
        s = np.random.default_rng(0).permutation(len(q))[:600]; q, nn = q[s], nn[s]
    return np.vstack([p,q]), np.vstack([n,nn]), np.vstack([c, np.full((len(q),3), np.nan)]), len(p)

def new_pixels(track):
    before, after = track.clip.before, track.clip.after
    with np.errstate(invalid="ignore"):
        raised = after.valid & (after.points[...,2] > 0.006)
        tol = 3*np.sqrt(2)*depth_sigma(after.depth.astype(float)) + 0.006
        dep = ~(np.abs(after.depth-before.depth) < tol)
        col = np.abs(track.colour_after.astype(float)-__import__("mstfilter.mst.tracking.features",fromlist=["x"]).smooth_colour(before,5)).max(axis=2) > 30
    src = track.flow.source
    foreign = (src>=0) & ~track.mask.ravel()[np.maximum(src,0)]
    m = raised & (dep|col)
    return m, foreign

def components(m, after, centre):
    m8 = cv2.morphologyEx(m.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3,3),np.uint8))
    n, lab, stats, _ = cv2.connectedComponentsWithStats(m8)
    out=[]
    for k in range(1,n):
        if stats[k,4] >= 30:
            px = lab==k
            pts = after.points[px]
            if np.linalg.norm(np.median(pts,axis=0)-centre) < 0.5: out.append((stats[k,4],px))
    out.sort(key=lambda t:-t[0])
    return out

def scores(track, model, motions, Q, full=False):
    P, N, C, _ = model
    after = track.clip.after
    x = move_points(motions, P)
    nrm = N @ np.swapaxes(motions[:, :3,:3], -1,-2)
    ray = x - after.camera.position
    facing = np.einsum("kni,kni->kn", nrm, ray) < -0.1*np.linalg.norm(ray,axis=-1)
    u,v,z,inside = after.camera.pixels_of(x)
    meas = after.depth[v,u].astype(float)
    valid = inside & after.valid[v,u]
    behind = z-meas
    known = np.isfinite(C[:,0])
    s = 1.5*np.sqrt(2)*depth_sigma(meas)
    s = np.where(known, s, np.sqrt(s**2+0.007**2))
    with np.errstate(invalid="ignore"):
        cost = np.minimum(np.abs(behind)/s, 4)**2
        hidden = behind > np.where(known, .015, .022)
        col = np.linalg.norm(track.colour_after[v,u]-C, axis=-1)
        ccost = np.where(known, np.minimum(col/25,4)**2, 0)
    cost = np.where(hidden, 5.6, cost + ccost)
    counted = facing & valid
    w = np.where(known, 1.0, 0.5)
    n = (counted*w).sum(-1)
    outside = (facing & ~inside)
    mean = ((np.where(counted,cost,0)*w).sum(-1) + 16*(outside*w).sum(-1))/np.maximum(n+(outside*w).sum(-1),1)
    vis = (counted&~hidden).sum(-1)/np.maximum(facing.sum(-1),1)
    q = Q[::max(1,len(Q)//150)]
    tree = cKDTree(P)
    d,_ = tree.query(move_points(invert(motions), q), distance_upper_bound=0.05)
    un = np.minimum(np.where(np.isfinite(d),d,.05)/0.012, 1)**2
    return mean + 4*un.mean(-1) + np.where(vis<.15, 5, 0)

def orientations(points):
    rect = cv2.minAreaRect(((points[:,:2]-points[:,:2].mean(0))).astype(np.float32))
    a = np.deg2rad(rect[2])
    R0 = Rotation.from_euler("z", a).as_matrix()
    C = [np.eye(3)] + [Rotation.from_euler("x", d, degrees=True).as_matrix() for d in (90,180,270)] + [Rotation.from_euler("y", d, degrees=True).as_matrix() for d in (90,270)]
    out=[]
    for c in C:
        for yaw in np.arange(0,360,15):
            out.append(Rotation.from_euler("z", yaw, degrees=True).as_matrix() @ R0 @ c @ R0.T)
    return np.array(out)

def place(track, voxels, grid, Qmask=None, keep=12):
    model = model_of(track, voxels, grid)
    P,N,C,n0 = model
    after = track.clip.after
    centre = P.mean(0)
    if Qmask is None:
        m, foreign = new_pixels(track)
        comps = components(m & ~foreign, after, centre)[:3] + components(m, after, centre)[:4]
        Qs = [after.points[c[1]].astype(float) for c in comps]
    else:
        Qs = [after.points[Qmask & after.valid].astype(float)]
    R = orientations(P)
    out=[]
    for Q in Qs:
        if len(Q) < 12: continue
        mot=[]
        for r in R:
            x = (P-centre) @ r.T
            nn = N @ r.T
            for bottom in (0.0, None):
                T = np.eye(4); T[:3,:3]=r
                zoff = -x[:,2].min() if bottom is not None else np.percentile(Q[:,2],95)-np.percentile(x[:,2],98)
                if bottom is None and abs(zoff + x[:,2].min()) < .015: continue
                guess = np.array([*np.median(Q[:,:2],axis=0), zoff])
                for _ in range(2):
                    ray = x+guess-after.camera.position
                    f = (nn*ray).sum(1) < -0.1*np.linalg.norm(ray,axis=1)
                    if f.sum()<5: break
                    guess[:2] = Q[:,:2].mean(0) - x[f][:,:2].mean(0)
                for dx in (0,):
                    T2=T.copy(); T2[:3,3]=guess - r@centre; mot.append(T2)
        mot=np.array(mot)
        s = scores(track, model, mot, Q)
        order=np.argsort(s)[:keep]
        src = prepare(P); tgt = prepare(Q)
        best=[]
        for k in order:
            T=mot[k]
            cand=[T]
            if src is not None and tgt is not None:
                # the visible part of the model
                nrm=N@T[:3,:3].T; x=move_points(T,P); ray=x-after.camera.position
                f=(nrm*ray).sum(1) < -0.1*np.linalg.norm(ray,axis=1)
                part=prepare(P[f]) if f.sum()>20 else src
                if part is not None:
                    fit=SmallGicp().register(tgt, part, invert(T), 0.03)
                    if fit is not None: cand.append(invert(fit.T))
            cand.append(refine_motion(track, cand[-1]))
            cand.append(refine_motion(track, T))
            cand=np.array(cand)
            sc=scores(track, model, cand, Q)
            j=int(sc.argmin()); best.append((sc[j],cand[j]))
        out += best
    out.sort(key=lambda t:t[0])
    return out, model, Qs

if __name__=="__main__":
    only_turned = float(sys.argv[1]) if len(sys.argv)>1 else 60
    for path in sorted(Path("/work/rec").glob("topple-*")):
        recording, manifest = open_recording(path), json.loads((path/"manifest.json").read_text())
        family = SceneFamily(**{f.name: manifest["family"][f.name] for f in fields(SceneFamily) if f.name in manifest["family"]})
        seed=manifest["seed"]
        shapes=draw_objects(stream(seed,"things"), family, family.pool(seed)).shapes
        for t, clip in enumerate(recording.clips()[1:], start=1):
            first,last=recording.pauses[t-1],recording.pauses[t]
            pb,pa=recording.poses(first),recording.poses(last)
            hyp=Hypothesis.from_labels(recording.truth(t-1), clip.grid)
            flow=None
            seg=segments_of(hyp, clip.before)
            for k in hyp.volumes():
                T=pa[k]@np.linalg.inv(pb[k])
                if turned(T) < only_turned or k not in seg: continue
                if flow is None: flow=DenseFlow().track(clip)
                pix=[int((recording.instance(j)==k).sum()) for j in (first,last)]
                track=Track(seg[k],clip,flow)
                if not len(track.segment.support): continue
                surf=surface_points(shapes[k-1])
                res=MotionResidual()
                cands=MstRule().candidates(np.random.default_rng(0), track)
                b=min(cands,key=lambda c:c.score)
                e0=error_mm(shapes[k-1],surf,pb[k],pa[k],b.T.as_matrix())
                vox=np.flatnonzero(hyp.labels.ravel()==k)
                began=time.process_time()
                found,model,Qs=place(track,vox,clip.grid)
                took=time.process_time()-began
                truemask=recording.instance(last)==k
                oracle,_,_=place(track,vox,clip.grid,Qmask=truemask)
                def err(M):
                    off=np.linalg.inv(pa[k])@M@pb[k]; mv=surf@off[:3,:3].T+off[:3,3]
                    return (round(error_mm(shapes[k-1],surf,pb[k],pa[k],M)), round(1000*float(cKDTree(surf).query(mv)[0].mean()),1))
                e0=err(b.T.as_matrix())
                qt=clip.after.points[truemask&clip.after.valid].astype(float)
                st=scores(track,model,T[None],qt)[0] if len(qt)>12 else np.nan
                print(path.name,t,k,shapes[k-1].name,"turn",turned(T),"pix",pix,"now",round(b.score,2),b.kind,e0,"S(truth)",round(res.score(track,T),2),
                      "| whole",[(round(float(s),2),err(M)) for s,M in found[:3]],"oracleQ",[(round(float(s),2),err(M)) for s,M in oracle[:3]],"S'(truth)",round(float(st),2),"s",round(took,1),flush=True)
